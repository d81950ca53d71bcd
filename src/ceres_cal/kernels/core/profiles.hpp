// The normal equations of edges, or lines of paint, in the pixels around places: see detect/profiles.py, which has the
// model.
#pragma once

#include <cmath>
#include <vector>

#include "chunk.hpp"

namespace ceres_cal {

// The normal distribution and its density by cubics between the places of a table: right to 1e-9, in SIMD registers.
class NormalTable {
  public:
    NormalTable() noexcept {
        for (int k = 0; k < COUNT; ++k) {
            const double x = k / PER_UNIT - END;
            high_[k] = 0.5 * std::erfc(-x / std::sqrt(2.0));
            bell_[k] = std::exp(-0.5 * x * x) / std::sqrt(2.0 * PI);
        }
    }

    void look_up(double x, double& high, double& bell) const {
        x = std::max(-END, std::min(x, END));
        const double place = (x + END) * PER_UNIT;
        const int k = std::min(static_cast<int>(place), COUNT - 2);
        const double t = place - k, u = 1.0 - t, near = k / PER_UNIT - END, far = near + 1.0 / PER_UNIT;
        const double h0 = u * u * (1.0 + 2.0 * t), h1 = 1.0 - h0, s0 = t * u * u / PER_UNIT, s1 = -t * t * u / PER_UNIT;
        const double b0 = bell_[k], b1 = bell_[k + 1];
        high = h0 * high_[k] + h1 * high_[k + 1] + s0 * b0 + s1 * b1;
        bell = h0 * b0 + h1 * b1 - s0 * near * b0 - s1 * far * b1;
    }

  private:
    static constexpr double END = 8.5, PER_UNIT = 32.0, PI = 3.14159265358979323846;
    static constexpr int COUNT = static_cast<int>(2.0 * END * PER_UNIT) + 1;
    double high_[COUNT], bell_[COUNT];
};

// What blurs and smears the edges of one window, and where they are: `offset` of them all, `edges` beside it.
struct Blurred {
    double blur, smear, lean, offset;
    const double *edges, *heights;
};

class ProfileEquations {
  public:
    // moves: whether places are asked for, too, by given heights; free: how many of blur, stretch and smear are.
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

    // normal (P, P) and right (P) of one window's pixels.
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
            for (int row = first; row < size_; ++row) rows[row][i] = 0.0;
        }
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

    // How high a step at `edge` is, and the derivatives of that by the distance and by the logarithm of the blur.
    void step(const Blurred& at, double edge, int filled, Lane& high) {
        const double blur = at.blur, *weight = weight_.value, *away = away_.value;
        double *up_to = high.value, *place = by_place_.value, *wider = by_blur_.value, *longer = by_smear_.value;
        each(filled, [=, &table = TABLE](int i) {
            const double w = weight[i], x = (away[i] - edge) / blur;
            double up, bell;
            table.look_up(x, up, bell);
            up_to[i] = w * up, place[i] = w * bell / blur, wider[i] = -w * bell * x, longer[i] = 0.0;
        });
    }

    // The same, and by the logarithm of the smear, which is a mean over its length: integrals of Phi make it.
    void smeared_step(const Blurred& at, double edge, int filled, Lane& high) {
        const double blur = at.blur, lean = at.lean, mean = 0.5 - lean / 6.0;
        const double length = at.smear / blur, q = 2.0 * lean / (length * length);
        const double heavy = (1.0 + lean) / length, light = (1.0 - lean) / length;
        const double *weight = weight_.value, *away = away_.value;
        double *up_to = high.value, *place = by_place_.value, *wider = by_blur_.value, *longer = by_smear_.value;
        each(filled, [=, &table = TABLE](int i) {
            const double w = weight[i], x = (away[i] - edge) / blur;
            const double a = x + mean * length, b = x + (mean - 1.0) * length;
            double up, bell, end, end_bell;
            table.look_up(a, up, bell), table.look_up(b, end, end_bell);
            const double a2 = a * up + bell, b2 = b * end + end_bell;
            const double a3 = 0.5 * ((a * a + 1.0) * up + a * bell), b3 = 0.5 * ((b * b + 1.0) * end + b * end_bell);
            const double rise = heavy * a2 - light * b2 - q * (a3 - b3);
            const double moved = length * (heavy * mean * up + light * (1.0 - mean) * end) -
                                 q * length * (mean * a2 + (1.0 - mean) * b2);
            up_to[i] = w * rise, place[i] = w * (heavy * up - light * end - q * (a2 - b2)) / blur;
            wider[i] = w * (heavy * bell - light * end_bell - q * (up - end));
            longer[i] = w * (moved + q * (a3 - b3) - rise);
        });
    }

    static inline const NormalTable TABLE;
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
