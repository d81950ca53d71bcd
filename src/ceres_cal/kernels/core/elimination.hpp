// Elimination of many placements, each seen by one station only, from the problem (variable projection).
//
// For given intrinsics each pose is solved for, and the Schur complement A_cc - A_cp A_pp^-1 A_pc of the normal
// equations is the information on what all sights share: the free intrinsics and the structure. Near the best pose one
// evaluation per sight is enough: the complement includes the rest of the step, and its cost.
#pragma once

#include "dense.hpp"
#include "sums.hpp"

namespace ceres_cal {

// Placements solved for at given shared numbers: see `Sweep` in `kernels/__init__.py`.
struct Sweep {
    double *poses, *gains, *costs, *reduced;
};

class Elimination {
  public:
    Elimination(Lens& lens, const Unknowns& unknowns, const Observed& seen, bool newton)
        : sums_(lens, unknowns, seen), newton_(newton), count_(unknowns.shared()), size_(unknowns.size()) {}

    // Solves for the pose of one sight: sets its cost, and adds its information on the shared numbers.
    void eliminate(int64_t sight, double tolerance, const double* change, const Sweep& sweep) {
        double *kept = sweep.poses + 12 * sight, *gains = sweep.gains + 6 * static_cast<int64_t>(count_) * sight;
        double pose[12] = {}, moved[12], step[6];
        for (int k = 0; k < 6; ++k) {
            step[k] = 0.0;
            for (int j = 0; j < count_; ++j) step[k] -= gains[count_ * k + j] * change[j];
        }
        move(kept, step, moved);
        if (std::isinf(tolerance)) return static_cast<void>(std::copy_n(moved, 12, kept));
        double cost = INFINITY, promise = INFINITY, damping = 0.0;
        for (int trial = 0; trial < MOST_STEPS; ++trial) {
            const double found = sums_.normal_equations(sight, moved, newton_, trial_.data());
            if (found <= cost) {
                std::copy_n(moved, 12, pose), normal_.swap(trial_);
                cost = found, damping *= 0.1;
            } else if (!std::isfinite(cost) || promise <= 1e-12 * cost) {
                break;  // nothing can be projected from the start; or only rounding is left
            } else {
                damping = std::max(1e-3, 10.0 * damping);
            }
            promise = solve_pose(damping);
            if (promise <= std::max(tolerance * cost, NOTHING_LEFT)) break;
            for (int k = 0; k < 6; ++k) step[k] = -gain(k)[count_];
            move(pose, step, moved);
        }
        sweep.costs[sight] = INFINITY;
        if (!std::isfinite(cost)) return;
        bool whole = true;
        if (damping > 0.0) promise = solve_pose(0.0), whole = promise <= 1e-2 * cost;
        for (int k = 0; k < 6; ++k) step[k] = whole ? -gain(k)[count_] : 0.0;
        move(pose, step, kept);
        for (int k = 0; k < 6; ++k) std::copy_n(gain(k), count_, gains + static_cast<int64_t>(count_) * k);
        add_complement(sweep.reduced);
        sweep.costs[sight] = cost - std::max(promise, 0.0);
    }

  private:
    static constexpr int MOST_STEPS = 50;
    static constexpr double NOTHING_LEFT = 1e-14;  // squared standard deviations

    const double* normal(int row) const { return normal_.data() + static_cast<size_t>(size_) * row; }
    double* gain(int row) { return gain_.data() + static_cast<size_t>(count_ + 1) * row; }

    // moved = the pose after a left perturbation: R <- exp(dw) R, t <- t + dt.
    static void move(const double* pose, const double* step, double* moved) {
        double turned[9];
        rotation(step, turned);
        multiply(3, 3, 3, turned, 3, pose, 4, moved, 4);
        for (int j = 0; j < 3; ++j) moved[4 * j + 3] = pose[4 * j + 3] + step[3 + j];
    }

    // gain (6, count + 1) = A_pp^-1 [A_pc A_pe] by Cholesky; an undetermined direction stays unchanged. Returns by how
    // much the step, minus gain's last column, should reduce the cost.
    double solve_pose(double damping) {
        double damped[36], upper[36], promise = 0.0;
        for (int k = 0; k < 6; ++k) {
            std::copy_n(normal(count_ + k) + count_, k + 1, damped + 6 * k), damped[7 * k] *= 1.0 + damping;
            std::copy_n(normal(count_ + k), count_, gain(k)), gain(k)[count_] = normal(count_ + 6)[count_ + k];
        }
        cholesky(6, damped, 6, upper, 1e-13);
        substitute(6, upper, gain_.data(), count_ + 1);
        for (int k = 0; k < 6; ++k) promise += gain(k)[count_] * normal(count_ + 6)[count_ + k];
        return promise;
    }

    // reduced += A_cc - A_cp A_pp^-1 A_pc, lower triangle, with the residual's row last.
    void add_complement(double* reduced) {
        const double *p[6], *last = normal(count_ + 6);
        for (int k = 0; k < 6; ++k) p[k] = normal(count_ + k);
        for (int i = 0; i <= count_; ++i) {
            double *own = reduced + static_cast<size_t>(count_ + 1) * i, g[6];
            const double* row = i == count_ ? last : normal(i);
            for (int k = 0; k < 6; ++k) g[k] = gain(k)[i];
            CERES_CAL_INDEPENDENT
            for (int j = 0; j < std::min(i + 1, count_); ++j)
                own[j] += row[j] - (g[0] * p[0][j] + g[1] * p[1][j] + g[2] * p[2][j] + g[3] * p[3][j] + g[4] * p[4][j] +
                                    g[5] * p[5][j]);
        }
        double left = last[count_ + 6];
        for (int k = 0; k < 6; ++k) left -= gain(k)[count_] * last[count_ + k];
        reduced[static_cast<size_t>(count_ + 1) * (count_ + 1) - 1] += left;
    }

    Sums sums_;
    const bool newton_;
    const int count_, size_;
    std::vector<double> normal_ = std::vector<double>(static_cast<size_t>(size_) * size_), trial_ = normal_;
    std::vector<double> gain_ = std::vector<double>(6 * static_cast<size_t>(count_ + 1));
};

}  // namespace ceres_cal
