// The robust losses, as Ceres defines them.
#pragma once

#include <cmath>
#include <type_traits>

#include "observations.hpp"

namespace ceres_cal {

// rho and its derivative at a squared residual.
struct Robust {
    double rho, slope;
};

template <LossCode code>
inline Robust robust(double scale, double squared) {
    const double b = scale * scale;
    if constexpr (code == LossCode::huber) {
        const double root = std::sqrt(squared);
        return squared <= b ? Robust{squared, 1.0} : Robust{2.0 * scale * root - b, scale / root};
    } else if constexpr (code == LossCode::soft_l1) {
        const double root = std::sqrt(1.0 + squared / b);
        return {2.0 * squared / (1.0 + root), 1.0 / root};  // 2 b (root - 1) without its rounding
    } else if constexpr (code == LossCode::cauchy) {
        return {b * std::log1p(squared / b), 1.0 / (1.0 + squared / b)};
    } else if constexpr (code == LossCode::tukey) {
        const double share = squared / b, rest = 1.0 - share;
        const double inside = squared * (1.0 - share + share * share / 3.0);  // b / 3 (1 - rest^3) without its rounding
        return squared < b ? Robust{inside, rest * rest} : Robust{b / 3.0, 0.0};
    } else {
        return {squared, 1.0};
    }
}

template <LossCode code>
using Chosen = std::integral_constant<LossCode, code>;

// function of the loss's code as a type, so that what it does with many residuals has no branches.
template <class Function>
inline auto with_loss(LossCode code, Function function) {
    switch (code) {
        case LossCode::huber: return function(Chosen<LossCode::huber>());
        case LossCode::soft_l1: return function(Chosen<LossCode::soft_l1>());
        case LossCode::cauchy: return function(Chosen<LossCode::cauchy>());
        case LossCode::tukey: return function(Chosen<LossCode::tukey>());
        default: return function(Chosen<LossCode::trivial>());
    }
}

// sqrt(1 + 2 s rho'' / rho') at the squared residual s: how the loss' own bend shortens the Jacobian along the residual
// (Triggs et al., Bundle Adjustment - A Modern Synthesis, section 4.3).
//
// 1 for the redescending losses: along their bend a step may climb.
inline double bend(const Loss& loss, double squared) {
    constexpr double STRAIGHT = 0.1;  // in place of 0, where a loss has no curvature left
    const double b = loss.scale * loss.scale;
    if (loss.code == LossCode::huber) return squared > b ? STRAIGHT : 1.0;
    return loss.code == LossCode::soft_l1 ? 1.0 / std::sqrt(1.0 + squared / b) : 1.0;
}

}  // namespace ceres_cal
