// The normal equations of edges, or lines of paint, over the pixels around them: see detect/profiles.py, which has the
// model.
#pragma once

#include <cmath>
#include <vector>

#include "chunk.hpp"

namespace ceres_cal {

// sum c_k x^k.
template <size_t terms>
inline double polynomial(const double (&c)[terms], double x) {
    double sum = c[terms - 1];
    for (size_t k = terms - 1; k > 0; --k) sum = sum * x + c[k - 1];
    return sum;
}

// The normal distribution and its density, accurate to 1e-10, in SIMD registers, in contrast to a table. It uses
// Chebyshev's polynomial of the density's 32nd root, and a rational function for the ratio of the tail probability to
// the density (Mills' ratio).
inline void normal_at(double x, double& high, double& bell) {
    constexpr double END = 8.5, ROOT_2_PI = 2.5066282746310002;
    constexpr double ROOT[] = {0.99999999999891462,    -0.99999999980795506,    0.49999999438103842,
                               -0.16666660275120043,   0.041666296381519918,    -0.0083320961566578377,
                               0.0013863566323375884,  -0.00019517033793429582, 2.2239535547383592e-05,
                               -1.5767049465645392e-06};
    constexpr double ABOVE[] = {1.253314137318346, 0.9319425359700528, 0.3462163654113242, 0.06602250211641049,
                                0.005504907672276598};
    constexpr double BELOW[] = {
        1.0, 1.541467122148889, 1.0061535022677326, 0.3507007142216959, 0.06610480230986611, 0.00550166690348795};
    const double away = std::min(std::abs(x), END);
    double power = polynomial(ROOT, away * away / 64.0);
    for (int k = 0; k < 5; ++k) power *= power;
    bell = power / ROOT_2_PI;
    high = 0.5 + std::copysign(0.5 - bell * polynomial(ABOVE, away) / polynomial(BELOW, away), x);
}

// The blur and smear of the edges of one window, and their places: `offset` of all edges, and `edges` beside it.
struct Blurred {
    double blur, smear, lean, offset;
    const double *edges, *heights;
};

class ProfileEquations {
  public:
    // moves: whether places are unknowns, too, with given heights. free: how many of blur, stretch and smear are.
    ProfileEquations(int edges, bool moves, int free, bool smears)
        : edges_(edges),
          moves_(moves),
          free_(free),
          smears_(smears),
          size_(2 + edges + (moves ? 1 + free : 0)),
          rows_(static_cast<size_t>(size_ + 1)),
          products_(static_cast<size_t>((size_ + 4) * (size_ + 4))) {
        for (Lane& row : rows_) own_.push_back(row.value);
    }

    int size() const { return size_; }

    // Computes normal (P, P) and right (P) of one window's pixels.
    void add_up(const Blurred& at, const double* distance, const double* values, int64_t pixels, double* normal,
                double* right) {
        std::fill_n(normal, size_ * size_, 0.0), std::fill_n(right, size_, 0.0);
        const int stride = size_ + 4;
        for (int64_t start = 0; start < pixels; start += CHUNK) {
            const int n = static_cast<int>(std::min<int64_t>(pixels - start, CHUNK));
            differentiate(at, distance + start, values + start, n);
            find_products(own_.data(), size_ + 1, (n + LANES - 1) / LANES * LANES, products_.data());
            for (int k = 0; k < size_; ++k) {
                for (int j = 0; j <= k; ++j) normal[size_ * k + j] += products_.data()[stride * k + j];
                right[k] += products_.data()[stride * size_ + k];
            }
        }
        for (int k = 0; k < size_; ++k)
            for (int j = 0; j < k; ++j) normal[size_ * j + k] = normal[size_ * k + j];
    }

  private:
    enum Place : uint8_t { EVEN, SLOPE, EDGE };

    void differentiate(const Blurred& at, const double* distance, const double* values, int n) {
        const int filled = (n + LANES - 1) / LANES * LANES, first = EDGE + edges_;
        Lane* const rows = rows_.data();
        for (int i = 0; i < filled; ++i) {
            away_[i] = distance[std::min(i, n - 1)] - at.offset, weight_[i] = i < n ? 1.0 : 0.0;
            rows[EVEN][i] = weight_[i], rows[SLOPE][i] = weight_[i] * away_[i];
            rows[size_][i] = weight_[i] * values[std::min(i, n - 1)];
        }
        for (int row = first; row < size_; ++row) std::fill_n(rows[row].value, filled, 0.0);
        for (int j = 0; j < edges_; ++j) {
            if (smears_)
                smeared_step(at, at.edges[j], filled, rows[EDGE + j]);
            else
                step(at, at.edges[j], filled, rows[EDGE + j]);
            if (!moves_) continue;
            const double height = at.heights[j];
            const double by[4] = {-height, height, -height * at.edges[j], height};
            const Lane* const slopes[4] = {&by_place_, &by_blur_, &by_place_, &by_smear_};
            for (int k = 0; k <= free_; ++k) {
                double *row = rows[first + k].value, times = by[k];
                const double* slope = slopes[k]->value;
                each(filled, [=](int i) { row[i] += times * slope[i]; });
            }
        }
    }

    // The value of a step at `edge`, and its derivatives by the distance and by the logarithm of the blur.
    void step(const Blurred& at, double edge, int filled, Lane& high) {
        const double sharp = 1.0 / at.blur, *weight = weight_.value, *away = away_.value;
        double *up_to = high.value, *place = by_place_.value, *wider = by_blur_.value, *longer = by_smear_.value;
        each(filled, [=](int i) {
            const double w = weight[i], x = sharp * (away[i] - edge);
            double up, bell;
            normal_at(x, up, bell);
            up_to[i] = w * up, place[i] = w * bell * sharp, wider[i] = -w * bell * x, longer[i] = 0.0;
        });
    }

    // The same, and by the logarithm of the smear, which is a mean over its length: it follows from integrals of Phi.
    void smeared_step(const Blurred& at, double edge, int filled, Lane& high) {
        const double sharp = 1.0 / at.blur, lean = at.lean, mean = 0.5 - lean / 6.0;
        const double length = at.smear * sharp, q = 2.0 * lean / (length * length);
        const double heavy = (1.0 + lean) / length, light = (1.0 - lean) / length;
        const double *weight = weight_.value, *away = away_.value;
        double *up_to = high.value, *place = by_place_.value, *wider = by_blur_.value, *longer = by_smear_.value;
        each(filled, [=](int i) {
            const double w = weight[i], x = sharp * (away[i] - edge);
            const double a = x + mean * length, b = x + (mean - 1.0) * length;
            double up, bell, end, end_bell;
            normal_at(a, up, bell), normal_at(b, end, end_bell);
            const double a2 = a * up + bell, b2 = b * end + end_bell;
            const double a3 = 0.5 * ((a * a + 1.0) * up + a * bell), b3 = 0.5 * ((b * b + 1.0) * end + b * end_bell);
            const double rise = heavy * a2 - light * b2 - q * (a3 - b3);
            const double moved = length * (heavy * mean * up + light * (1.0 - mean) * end) -
                                 q * length * (mean * a2 + (1.0 - mean) * b2);
            up_to[i] = w * rise, place[i] = w * (heavy * up - light * end - q * (a2 - b2)) * sharp;
            wider[i] = w * (heavy * bell - light * end_bell - q * (up - end));
            longer[i] = w * (moved + q * (a3 - b3) - rise);
        });
    }

    const int edges_;
    const bool moves_;
    const int free_;
    const bool smears_;
    const int size_;
    std::vector<Lane> rows_;
    std::vector<double> products_;
    std::vector<double*> own_;
    Lane away_, weight_, by_place_, by_blur_, by_smear_;
};

}  // namespace ceres_cal
