// The arguments of the kernels as plain pointers: see `kernels/__init__.py`, which describes each.
#pragma once

#include <cmath>
#include <type_traits>

#include "chunk.hpp"

namespace ceres_cal {

constexpr int BUILT = 10;    // most structure numbers that move a point
constexpr int ON_TRACK = 3;  // most structure numbers that move a track

// RESIDUALS: number of residuals of each observation. MOVED: most structure numbers that move it. moved(k): row of k's
// slots.
struct Points {
    static constexpr int RESIDUALS = 2, MOVED = BUILT;
    const int64_t* bounds;
    const double *places, *pixels, *weights;
    const int32_t* slots;  // null without structure
    const double* bends;
    int64_t moved(int64_t k) const { return k; }
};

struct Curves {
    static constexpr int RESIDUALS = 1, MOVED = ON_TRACK;
    const int64_t* bounds;
    const double* tracks;
    const bool* is_arc;
    const int32_t* track;
    const double *pixels, *weights;
    double* feet;
    const int32_t* slots;
    int64_t moved(int64_t k) const { return track[k]; }
};

// Calls of_chunk(start, n) for all chunks of a sight, of about equal length; returns false if any call does.
template <class Columns, class OfChunk>
inline bool all_chunks(const Columns& seen, int64_t sight, OfChunk of_chunk) {
    bool good = true;
    for (int64_t start = seen.bounds[sight], end = seen.bounds[sight + 1], n; start < end; start += n) {
        const int64_t left = end - start, chunks = (left + CHUNK - 1) / CHUNK;
        n = (left + chunks - 1) / chunks;
        good &= of_chunk(start, static_cast<int>(n));
    }
    return good;
}

enum class LossCode : uint8_t { trivial, huber, soft_l1, cauchy, tukey };

struct Loss {
    LossCode code;
    double scale;
};

// The observations of sights, and the loss with which they are judged.
struct Observed {
    Points points;
    Curves curves;
    Loss loss;
};

// The numbers that take part: the columns of A are [free intrinsics | structure | 6 pose | residual].
struct Unknowns {
    const int64_t* free;
    int count, structure;
    int shared() const { return count + structure; }
    int size() const { return shared() + 7; }
};

// ---- the robust losses, as Ceres defines them ----

// rho and its derivative at a squared residual s; and sqrt(1 + 2 s rho'' / rho'), the factor by which the curvature of
// the loss shortens the Jacobian along the residual (Triggs et al., Bundle Adjustment - A Modern Synthesis, section
// 4.3). For Cauchy's loss, rho = b log(1 + s / b) is given as s / b, from which `sum_of_logs` computes it.
//
// The bend is 1 for redescending losses: along their curvature a step may climb.
struct Robust {
    double rho, slope, bend = 1.0;
};

template <LossCode code>
inline Robust robust(double scale, double squared) {
    constexpr double STRAIGHT = 0.1;  // instead of 0, where a loss has no curvature left
    const double b = scale * scale;
    if constexpr (code == LossCode::huber) {
        const double root = std::sqrt(squared);
        return squared <= b ? Robust{squared, 1.0} : Robust{2.0 * scale * root - b, scale / root, STRAIGHT};
    } else if constexpr (code == LossCode::soft_l1) {
        const double root = std::sqrt(1.0 + squared / b);
        return {2.0 * squared / (1.0 + root), 1.0 / root, 1.0 / root};  // 2 b (root - 1) without its rounding
    } else if constexpr (code == LossCode::cauchy) {
        return {squared / b, 1.0 / (1.0 + squared / b)};
    } else if constexpr (code == LossCode::tukey) {
        const double share = squared / b, rest = 1.0 - share;
        const double inside = squared * (1.0 - share + share * share / 3.0);  // b / 3 (1 - rest^3) without its rounding
        return squared < b ? Robust{inside, rest * rest} : Robust{b / 3.0, 0.0};
    } else {
        return {squared, 1.0};
    }
}

// Sum of log(1 + more) over n numbers, a multiple of LANES: a logarithm of each would take longer than everything else
// for a residual. Few factors are multiplied at once, so that no product overflows; products are kept minus one, so
// that none is lost in rounding.
inline double sum_of_logs(int n, const double* more) {
    constexpr int FACTORS = 8;
    double sum = 0.0;
    for (int first = 0; first < n; first += FACTORS) {
        double product[LANES] = {}, whole = 0.0;
        for (int i = first; i < std::min(first + FACTORS, n); i += LANES)
            for (int k = 0; k < LANES; ++k) product[k] += more[i + k] * (1.0 + product[k]);
        for (const double part : product) whole += part * (1.0 + whole);
        sum += std::log1p(whole);
    }
    return sum;
}

template <LossCode code>
using Chosen = std::integral_constant<LossCode, code>;

// Calls a function with the loss's code as a type, so that its loops over many residuals have no branches.
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

}  // namespace ceres_cal
