// Errors that are correlated along strands of observations: sums for their likelihood (effects/likelihood.py).
#pragma once

#include <cstdint>
#include <vector>

#include "dense.hpp"

namespace ceres_cal {

// Sums over strands, shape by shape, for some shares a of correlated variance, with R = (1 - a) 1 + a K, along the
// eigenvectors of K.
class Strands {
  public:
    static constexpr int POSE = 6;

    // rows (size, strands, numbers): six of a private placement, those of shared numbers, the residual. group:
    // (strands) number of the placement, out of `groups`. Values are added to logs (shares), and subtracted from left
    // (shares, rest, rest).
    Strands(int size, int strands, int numbers, const double* rows, const int64_t* group, int64_t groups, int shares,
            const double* share, double* logs, double* left)
        : size_(size),
          strands_(strands),
          numbers_(numbers),
          rest_(numbers - POSE),
          shares_(shares),
          groups_(groups),
          rows_(rows),
          share_(share),
          group_(group),
          logs_(logs),
          left_(left),
          placed_(static_cast<size_t>(shares * groups * POSE * numbers)) {}

    // Adds the strands from first to last, all with the same eigenvalues (size): log det R, and the sums with private
    // placements.
    void add(int first, int last, const double* values) {
        const int own = POSE * numbers_;
        std::vector<double> weights(static_cast<size_t>(shares_) * size_);
        double* const weight = weights.data();
        for (int a = 0; a < shares_; ++a)
            for (int m = 0; m < size_; ++m) {
                const double variance = 1.0 - share_[a] * (1.0 - values[m]);
                weight[size_ * a + m] = 1.0 / variance;
                logs_[a] += (last - first) * std::log(variance);
            }
        const auto spread = [&](const std::vector<double>& products, int count, double* to, int64_t apart) {
            for (int a = 0; a < shares_; ++a)
                for (int m = 0; m < size_; ++m)
                    add_times(count, weight[size_ * a + m], products.data() + count * m, to + apart * a);
        };
        for (int s = first; s < last; ++s) {  // strands of a group are best consecutive; else they are added one by one
            if (s == first || group_[s] != group_[s - 1]) poses_.assign(static_cast<size_t>(size_) * own, 0.0);
            for (int m = 0; m < size_; ++m) {
                const double* x = rows_ + (static_cast<int64_t>(m) * strands_ + s) * numbers_;
                for (int j = 0; j < POSE; ++j) add_times(numbers_, x[j], x, poses_.data() + own * m + numbers_ * j);
            }
            if (s + 1 == last || group_[s + 1] != group_[s]) spread(poses_, own, placed(0, group_[s]), groups_ * own);
        }
    }

    // Eliminates private placements. Returns the number of their numbers.
    int64_t eliminate() {
        int64_t taken = 0;
        for (int a = 0; a < shares_; ++a)
            for (int64_t g = 0; g < groups_; ++g) {
                const int own = eliminate_one(placed(a, g), logs_[a], left_ + a * rest_ * rest_);
                if (a == 0) taken += own;
            }
        return taken;
    }

  private:
    static void add_times(int count, double factor, const double* of, double* to) {
        CERES_CAL_INDEPENDENT
        for (int i = 0; i < count; ++i) to[i] += factor * of[i];
    }

    double* placed(int a, int64_t g) { return placed_.data() + (a * groups_ + g) * POSE * numbers_; }

    // placed (6, numbers): the normal equations of one group, and their coupling with the rest.
    int eliminate_one(const double* placed, double& log, double* left) {
        constexpr double NOTHING = 1e-9;
        double normal[POSE * POSE] = {}, upper[POSE * POSE];
        coupling_.assign(static_cast<size_t>(rest_) * POSE, 0.0);
        double* const coupling = coupling_.data();
        int taken = 0;
        for (int j = 0; j < POSE; ++j) {
            normal[(POSE + 1) * j] = 1.0;
            if (!(placed[(numbers_ + 1) * j] > NOTHING)) continue;
            ++taken;
            for (int i = 0; i <= j; ++i)
                if (placed[(numbers_ + 1) * i] > NOTHING) normal[POSE * j + i] = placed[numbers_ * j + i];
            std::copy_n(placed + numbers_ * j + POSE, rest_, coupling + rest_ * j);
        }
        if (taken == 0) return 0;
        cholesky(POSE, normal, POSE, upper);
        solved_ = coupling_;
        substitute(POSE, upper, solved_.data(), rest_);
        for (int j = 0; j < POSE; ++j) {
            if (upper[(POSE + 1) * j] > 0.0) log += 2.0 * std::log(upper[(POSE + 1) * j]);
            for (int i = 0; i < rest_; ++i)
                add_times(rest_, -coupling[rest_ * j + i], solved_.data() + rest_ * j, left + rest_ * i);
        }
        return taken;
    }

    int size_, strands_, numbers_, rest_, shares_;
    int64_t groups_;
    const double *rows_, *share_;
    const int64_t* group_;
    double *logs_, *left_;
    std::vector<double> placed_, poses_, coupling_, solved_;
};

}  // namespace ceres_cal
