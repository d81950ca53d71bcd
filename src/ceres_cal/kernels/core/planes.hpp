// Homographies of very many sights of points at once, each reweighted against its own wrong labels.
#pragma once

#include <cstdint>
#include <vector>

#include "dense.hpp"

namespace ceres_cal {

// Of at least one number, which it orders.
inline double median(std::vector<double>& values) {
    const auto half = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    const auto before = [](double a, double b) { return a < b || (b != b && a == a); };  // what is no number comes last
    std::nth_element(values.begin(), half, values.end(), before);
    return values.size() % 2 == 1 ? *half : 0.5 * (*std::max_element(values.begin(), half, before) + *half);
}

// The unit vector that `normal` (SIZE squared, lower triangle) shrinks most, by inverse iteration from h.
inline void least_direction(double* normal, double* h) {
    constexpr int SIZE = 9;
    double upper[SIZE * SIZE], trace = 0.0;
    for (int i = 0; i < SIZE; ++i) trace += normal[(SIZE + 1) * i];
    for (int i = 0; i < SIZE; ++i) normal[(SIZE + 1) * i] += 1e-13 * trace;
    cholesky(SIZE, normal, SIZE, upper);
    for (int round = 0; round < 4; ++round) {
        substitute(SIZE, upper, h);
        double squared = 0.0;
        for (int i = 0; i < SIZE; ++i) squared += h[i] * h[i];
        for (int i = 0; i < SIZE; ++i) h[i] /= std::sqrt(squared);
    }
}

class Homographies {
  public:
    // profile: c_k of w = 1 + sum c_k r^2k, which makes q = (p, w); p and r are offsets and their lengths over `unit`.
    // wrong: medians of the errors beyond which one is a wrong label's.
    Homographies(const double* profile, int terms, double unit, double wrong)
        : profile_(profile), terms_(terms), unit_(unit), wrong_(wrong) {}

    // H (3, 3) of one sight with q ~ H (x, y, 1), sign by most of its points, and each point's error (n).
    void fit(int64_t n, const double* plane, const double* offsets, double* homography, double* errors) {
        constexpr int PATIENCE = 8;  // rounds of reweighting where some points do not fit
        for (std::vector<double>* one : {&x_, &y_, &a_, &b_, &c_}) one->resize(static_cast<size_t>(n));
        weights_.assign(static_cast<size_t>(n), 1.0);
        double lift[3], normal[81], h[9];
        load(n, plane, offsets, lift);
        for (int i = 0; i < 9; ++i) h[i] = 1.0 + 0.1 * i;  // anything: what the moments shrink more vanishes soon
        for (int round = 0; round < PATIENCE; ++round) {
            add_moments(n, normal);
            least_direction(normal, h);
            judge(n, h, errors);
            ordered_.assign(errors, errors + n);
            const double usual = median(ordered_), worst = *std::max_element(errors, errors + n);
            if (worst <= wrong_ * usual) break;
            for (int64_t i = 0; i < n; ++i) {
                const double far = errors[i] / (1.5 * usual + 1e-12);
                weights_[i] /= 1.0 + far * far;
            }
        }
        for (int j = 0; j < 3; ++j) {
            const double a = h[3 * j] * lift[2], b = h[3 * j + 1] * lift[2];
            homography[3 * j] = a, homography[3 * j + 1] = b;
            homography[3 * j + 2] = h[3 * j + 2] - a * lift[0] - b * lift[1];
        }
    }

  private:
    // x and y: the plane's points with their centroid at 0 and unit spread, lift (3): centroid and 1 / spread; and q.
    void load(int64_t n, const double* plane, const double* offsets, double* lift) {
        double spread = 0.0;
        lift[0] = lift[1] = 0.0;
        for (int64_t i = 0; i < 2 * n; ++i) lift[i % 2] += plane[i] / static_cast<double>(n);
        for (int64_t i = 0; i < n; ++i) {
            x_[i] = plane[2 * i] - lift[0], y_[i] = plane[2 * i + 1] - lift[1];
            spread += x_[i] * x_[i] + y_[i] * y_[i];
            const double a = a_[i] = offsets[2 * i] / unit_, b = b_[i] = offsets[2 * i + 1] / unit_;
            c_[i] = 0.0;
            for (int k = terms_ - 1; k >= 0; --k) c_[i] = (c_[i] + profile_[k]) * (a * a + b * b);
            c_[i] += 1.0;
        }
        lift[2] = 1.0 / (std::sqrt(spread / static_cast<double>(n)) + 1e-12);
        for (int64_t i = 0; i < n; ++i) x_[i] *= lift[2], y_[i] *= lift[2];
    }

    // normal (9, 9), lower triangle: of q_w (h1 . X) - q_x (h3 . X) = 0 and q_w (h2 . X) - q_y (h3 . X) = 0.
    void add_moments(int64_t n, double* normal) const {
        constexpr int PLACES[5][2] = {{0, 0}, {3, 3}, {6, 0}, {6, 3}, {6, 6}};
        constexpr int PRODUCTS[3][3] = {{0, 1, 3}, {1, 2, 4}, {3, 4, 5}};
        double sums[5][6] = {};
        const double *x = x_.data(), *y = y_.data(), *qa = a_.data(), *qb = b_.data(), *qc = c_.data();
        for (int64_t i = 0; i < n; ++i) {
            const double w = weights_[i], a = qa[i], b = qb[i], c = qc[i], ww = w * c * c;
            const double factor[5] = {ww, ww, -w * c * a, -w * c * b, w * (a * a + b * b)};
            const double product[6] = {x[i] * x[i], x[i] * y[i], y[i] * y[i], x[i], y[i], 1.0};
            for (int f = 1; f < 5; ++f)
                for (int p = 0; p < 6; ++p) sums[f][p] += factor[f] * product[p];
        }
        std::copy_n(sums[1], 6, sums[0]);
        std::fill_n(normal, 81, 0.0);
        for (int f = 0; f < 5; ++f) {
            for (int j = 0; j < 3; ++j)
                for (int k = 0; k < 3; ++k) normal[9 * (PLACES[f][0] + j) + PLACES[f][1] + k] = sums[f][PRODUCTS[j][k]];
        }
    }

    // Distance of each measured point from where h sends it, in q's unit, and 1 / depth^2 as weights.
    void judge(int64_t n, double* h, double* errors) {
        int64_t agree = 0;
        for (int64_t i = 0; i < n; ++i) {
            const double x = x_[i], y = y_[i], u = h[0] * x + h[1] * y + h[2], v = h[3] * x + h[4] * y + h[5];
            const double depth = h[6] * x + h[7] * y + h[8], away = std::abs(depth) > 1e-9 ? depth : 1e-9;
            agree += u * a_[i] + v * b_[i] + depth * c_[i] > 0.0 ? 1 : -1;
            const double dx = u * c_[i] / away - a_[i], dy = v * c_[i] / away - b_[i];
            errors[i] = std::sqrt(dx * dx + dy * dy);
            weights_[i] = 1.0 / (away * away);
        }
        for (int i = 0; i < 9 && agree < 0; ++i) h[i] = -h[i];
    }

    const double* profile_;
    int terms_;
    double unit_, wrong_;
    std::vector<double> x_, y_, a_, b_, c_, weights_, ordered_;
};

}  // namespace ceres_cal
