// The compressed block of one sight, as Ceres asks for it (design, section 6).
//
// A = sum w [J e]^T [J e] over [free intrinsics | structure | 6 pose | e] is factored as A = U^T U; the rows of U are
// the Jacobian that Ceres sees, their last column its residual. Station and placement follow by the chain rule on U.
#pragma once

#include "dense.hpp"
#include "sums.hpp"

namespace ceres_cal {

constexpr double ROUNDING = 1e-9;  // of a cost

// pose = station @ placement, and the left perturbation of pose that a change of either vector makes.
struct Chain {
    double pose[12], to_station[36] = {}, to_placement[36] = {};

    // With R = R_s R_p and t = R_s t_p + t_s: dw = dw_s + R_s dw_p, dt = dw_s x (R_s t_p) + dt_s + R_s dt_p.
    Chain(const double* station, const double* placement) {
        double first[9], second[9], left[9], turned[3];
        rotation(station, first), rotation(placement, second);
        for (int j = 0; j < 3; ++j) {
            for (int k = 0; k < 3; ++k)
                pose[4 * j + k] =
                    first[3 * j] * second[k] + first[3 * j + 1] * second[3 + k] + first[3 * j + 2] * second[6 + k];
            turned[j] = first[3 * j] * placement[3] + first[3 * j + 1] * placement[4] + first[3 * j + 2] * placement[5];
            pose[4 * j + 3] = turned[j] + station[3 + j];
        }
        left_jacobian(station, left);
        for (int k = 0; k < 3; ++k) {
            const double x = left[k], y = left[3 + k], z = left[6 + k];
            to_station[k] = x, to_station[6 + k] = y, to_station[12 + k] = z;
            to_station[18 + k] = y * turned[2] - z * turned[1];
            to_station[24 + k] = z * turned[0] - x * turned[2];
            to_station[30 + k] = x * turned[1] - y * turned[0];
            to_station[21 + 7 * k] = 1.0;
        }
        left_jacobian(placement, left);
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) {
                to_placement[6 * j + k] =
                    first[3 * j] * left[k] + first[3 * j + 1] * left[3 + k] + first[3 * j + 2] * left[6 + k];
                to_placement[21 + 6 * j + k] = first[3 * j + k];
            }
    }
};

// Columns of U from `first` on as the row-major Jacobian of one block; nothing where the block is held.
inline void copy_plain(int size, const double* upper, int first, int count, double* jacobian) {
    if (jacobian == nullptr) return;
    std::fill_n(jacobian, static_cast<size_t>(size) * count, 0.0);
    for (int row = 0; row < size - 1; ++row) std::copy_n(upper + size * row + first, count, jacobian + count * row);
}

// U's pose columns times the chain rule, as the row-major Jacobian of one 6-vector block.
inline void copy_chained(int size, const double* upper, int first, const double* chain, double* jacobian) {
    if (jacobian == nullptr) return;
    std::fill_n(jacobian, static_cast<size_t>(size) * 6, 0.0);
    for (int row = 0; row < size - 1; ++row)
        for (int j = 0; j < 6; ++j)
            for (int k = 0; k < 6; ++k) jacobian[6 * row + k] += upper[size * row + first + j] * chain[6 * j + k];
}

// One array for each of Ceres's parameter blocks of a sight, null where the block is held.
struct Jacobians {
    double *camera, *station, *placement, *structure;
};

// What Ceres asks of the block of the first sight; false where an observation cannot be projected.
inline bool evaluate_block(const Optics& optics, const Unknowns& unknowns, const Points& points, const Curves& curves,
                           const Loss& loss, const double* station, const double* placement, double* residuals,
                           const Jacobians& jacobians) {
    const int size = unknowns.size(), last = size - 1;
    const Chain chain(station, placement);
    Sums sums(optics, unknowns);
    std::vector<double> normal(static_cast<size_t>(size) * size), upper(normal.size());
    double missing = 0.0;
    for (const bool newton : {true, false}) {
        const double cost = sums.normal_equations(0, chain.pose, points, curves, loss, newton, normal.data());
        if (!std::isfinite(cost)) return false;
        cholesky(size, normal.data(), size, upper.data());
        missing = cost;
        for (int row = 0; row < last; ++row) {
            residuals[row] = upper[size * row + last];
            missing -= residuals[row] * residuals[row];
        }
        if (missing > -ROUNDING * cost) break;  // else Newton's step promises more than there is
    }
    residuals[last] = std::sqrt(std::max(missing, 0.0));
    copy_plain(size, upper.data(), 0, unknowns.count, jacobians.camera);
    copy_plain(size, upper.data(), unknowns.count, unknowns.structure, jacobians.structure);
    copy_chained(size, upper.data(), unknowns.shared(), chain.to_station, jacobians.station);
    copy_chained(size, upper.data(), unknowns.shared(), chain.to_placement, jacobians.placement);
    return true;
}

}  // namespace ceres_cal
