// The compressed block of one sight, as Ceres uses it (design, section 6).
//
// A = sum w [J e]^T [J e] over [free intrinsics | structure | 6 pose | e] is factored as A = U^T U. The rows of U are
// the Jacobian that Ceres sees, and their last column its residual. The Jacobian by station and placement follows from
// U by the chain rule.
#pragma once

#include "dense.hpp"
#include "sums.hpp"

namespace ceres_cal {

constexpr double ROUNDING = 1e-9;  // relative, of a cost

// pose = station @ placement, and the left perturbation of the pose by a change of either vector.
struct Chain {
    double pose[12], to_station[36] = {}, to_placement[36] = {};

    // With R = R_s R_p and t = R_s t_p + t_s: dw = dw_s + R_s dw_p, dt = dw_s x (R_s t_p) + dt_s + R_s dt_p.
    Chain(const double* station, const double* placement) {
        double first[9], second[9], left[9], turned[3], across[9];
        rotation(station, first), rotation(placement, second);
        multiply(3, 3, 3, first, 3, second, 3, pose, 4);
        multiply(3, 3, 1, first, 3, placement + 3, 1, turned, 1);
        turn(turned, 0.0, 0.0, -1.0, across);
        left_jacobian(station, left);
        multiply(3, 3, 3, across, 3, left, 3, to_station + 18, 6);
        for (int k = 0; k < 3; ++k) {
            pose[4 * k + 3] = turned[k] + station[3 + k];
            std::copy_n(left + 3 * k, 3, to_station + 6 * k), to_station[21 + 7 * k] = 1.0;
            std::copy_n(first + 3 * k, 3, to_placement + 21 + 6 * k);
        }
        left_jacobian(placement, left);
        multiply(3, 3, 3, first, 3, left, 3, to_placement, 6);
    }
};

// Copies `count` columns of U from `first` on, times the chain rule if there is one, to the row-major Jacobian of a
// block; nothing if the block is held.
inline void copy_columns(int size, const double* upper, int first, int count, const double* chain, double* jacobian) {
    if (jacobian == nullptr) return;
    std::fill_n(jacobian, static_cast<size_t>(size) * count, 0.0);
    if (chain != nullptr) return multiply(size - 1, 6, 6, upper + first, size, chain, 6, jacobian, 6);
    for (int row = 0; row < size - 1; ++row) std::copy_n(upper + size * row + first, count, jacobian + count * row);
}

// Evaluates the block of the first sight for Ceres; returns false if an observation cannot be projected. jacobians: by
// camera, station, placement and structure, null if held.
inline bool evaluate_block(Lens& lens, const Unknowns& unknowns, const Observed& seen, const double* station,
                           const double* placement, double* residuals, double* const* jacobians) {
    const int size = unknowns.size(), last = size - 1;
    const Chain chain(station, placement);
    Sums sums(lens, unknowns, seen);
    std::vector<double> normal(static_cast<size_t>(size) * size), upper(normal.size());
    double missing = 0.0;
    for (const bool newton : {true, false}) {
        const double cost = sums.normal_equations(0, chain.pose, newton, normal.data());
        if (!std::isfinite(cost)) return false;
        cholesky(size, normal.data(), size, upper.data());
        missing = cost;
        for (int row = 0; row < last; ++row) {
            residuals[row] = upper[size * row + last];
            missing -= residuals[row] * residuals[row];
        }
        if (missing > -ROUNDING * cost) break;  // otherwise Newton's step promises more than the cost
    }
    residuals[last] = std::sqrt(std::max(missing, 0.0));
    copy_columns(size, upper.data(), 0, unknowns.count, nullptr, jacobians[0]);
    copy_columns(size, upper.data(), unknowns.count, unknowns.structure, nullptr, jacobians[3]);
    copy_columns(size, upper.data(), unknowns.shared(), 6, chain.to_station, jacobians[1]);
    copy_columns(size, upper.data(), unknowns.shared(), 6, chain.to_placement, jacobians[2]);
    return true;
}

}  // namespace ceres_cal
