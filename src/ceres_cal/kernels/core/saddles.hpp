// The saddles around corners of a chessboard, each fitted to the pixels of a disc: see detect/saddles.py, which has the
// model. Edges in the picture are tanh of the distances from them.
#pragma once

#include <limits>
#include <vector>

#include "chunk.hpp"
#include "dense.hpp"

namespace ceres_cal {

struct Picture {
    const float* levels;
    int64_t height, width;
};

// tanh by Lambert's continued fraction of an eighth, doubled three times: accurate to 1e-9, in SIMD registers.
inline double smooth_step(double x) {
    constexpr double END = 10.0;
    const double y = 0.125 * std::max(-END, std::min(x, END)), y2 = y * y;
    double p = y * (10395.0 + y2 * (1260.0 + y2 * 21.0));
    double q = 10395.0 + y2 * (4725.0 + y2 * (210.0 + y2));
    for (int k = 0; k < 3; ++k) {
        const double twice = 2.0 * p * q;
        q = p * p + q * q, p = twice;
    }
    return p / q;
}

class Saddles {
  public:
    // Numbers of a start: those of `Place`, where the ones after the angles are NaN if unknown; then the bends of both
    // edges and the disc's radius. Numbers of a fit: those of `Place`, then the root mean square of the residuals, and
    // the standard deviations of x and y for noise of 1 in each pixel.
    static constexpr int SIZE = 11, START = SIZE + 3, FITTED = SIZE + 3;

    explicit Saddles(const Picture& picture) : picture_(picture) {}

    // Where light and sharpness are unknown, they are first fitted to every other pixel along both axes.
    void fit(const double* start, double* fitted) {
        constexpr double LARGE_PX = 8.0, ROUGH_PX = 2e-2, SETTLED_PX = 1e-3;
        std::fill_n(fitted, FITTED, NO_CORNER);
        double now[SIZE];
        std::copy_n(start, SIZE, now);
        if (std::isnan(now[SHARP]) && start[SIZE + 2] > LARGE_PX && cut(start, 2)) settle(ROUGH_PX, now);
        if (!cut(start, 1)) return;
        const double cost = settle(SETTLED_PX, now);
        std::copy_n(now, SIZE, fitted);
        fitted[SIZE] = std::sqrt(cost / static_cast<double>(many_));
        double covariance[SIZE][2] = {{1.0, 0.0}, {0.0, 1.0}};
        factor(0.0), substitute(SIZE, upper_, covariance[0], 2);
        for (int k = 0; k < 2; ++k)
            if (covariance[k][k] > 0.0) fitted[SIZE + 1 + k] = std::sqrt(covariance[k][k]);
    }

  private:
    enum Place : uint8_t { X, Y, ANGLE, SHARP = 4, MEAN, MEAN_X, MEAN_Y, CONTRAST, CONTRAST_X, CONTRAST_Y, LEFT };
    static constexpr int STRIDE = SIZE + 4;
    static constexpr double FARTHEST_PX = 1e3, NO_CORNER = std::numeric_limits<double>::quiet_NaN();

    // Selects the pixels of the disc, each `every`-th of a row and a column; returns false if its centre is not in the
    // picture.
    bool cut(const double* start, int64_t every) {
        const double radius = start[SIZE + 2];
        const auto is_in = [](double place, int64_t size) {
            return place > -0.5 && place < static_cast<double>(size) - 0.5;
        };
        if (!(is_in(start[0], picture_.width) && is_in(start[1], picture_.height) && radius >= 1.0 &&
              radius <= FARTHEST_PX))
            return false;
        const int64_t middle_x = std::llrint(start[0]), middle_y = std::llrint(start[1]),
                      half = std::llrint(std::ceil(radius)), side = 2 * half + 1;
        for (auto* one : {&x_, &y_, &level_, &weight_}) one->resize(static_cast<size_t>(side * side + LANES));
        double *xs = x_.data(), *ys = y_.data(), *levels = level_.data();
        size_t many = 0;
        for (int64_t y = std::max<int64_t>(middle_y - half, 0); y <= std::min(middle_y + half, picture_.height - 1);
             y += every)
            for (int64_t x = std::max<int64_t>(middle_x - half, 0); x <= std::min(middle_x + half, picture_.width - 1);
                 x += every) {
                const double dx = static_cast<double>(x) - start[0], dy = static_cast<double>(y) - start[1];
                xs[many] = static_cast<double>(x), ys[many] = static_cast<double>(y);
                levels[many] = picture_.levels[picture_.width * y + x];
                many += dx * dx + dy * dy <= radius * radius;  // a pixel outside is overwritten by the next one
            }
        for (double* one : {xs, ys, levels}) std::fill_n(one + many, LANES, one[many - 1]);
        std::fill_n(weight_.data(), many, 1.0), std::fill_n(weight_.data() + many, LANES, 0.0);
        many_ = many;
        std::copy_n(start + SIZE, 2, bend_);
        return true;
    }

    // Levenberg-Marquardt steps until one hardly moves the corner; the cost after that step is predicted.
    double settle(double settled_px, double* now) {
        constexpr int STEPS = 20;
        constexpr double BLUNTEST = 0.05, SHARPEST = 3.0;
        double trial[SIZE], step[SIZE], cost = std::isnan(now[SHARP]) ? guess(now) : add_up(now), damping = 1e-3;
        for (int round = 0; round < STEPS; ++round) {
            solve(damping, step);
            for (int k = 0; k < SIZE; ++k) trial[k] = now[k] + step[k];
            trial[SHARP] = std::max(BLUNTEST, std::min(trial[SHARP], SHARPEST));
            if (std::abs(step[X]) < settled_px && std::abs(step[Y]) < settled_px) {
                for (int k = 0; k < SIZE; ++k) cost -= step[k] * at(LEFT, k);
                std::copy_n(trial, SIZE, now);
                break;
            }
            normal_.swap(kept_);
            const double found = add_up(trial);
            if (found < cost) {
                std::copy_n(trial, SIZE, now);
                cost = found, damping = std::max(0.1 * damping, 1e-9);
            } else {
                normal_.swap(kept_), damping *= 10.0;
            }
        }
        return std::max(cost, 0.0);
    }

    // Initial mean and contrast of the disc, and the equations there.
    double guess(double* now) {
        constexpr double DIFFUSE = 0.7;
        now[SHARP] = DIFFUSE, std::fill(now + MEAN, now + SIZE, 0.0);
        add_up(now);
        const double count = at(MEAN, MEAN), shape = at(CONTRAST, MEAN);
        now[MEAN] = at(LEFT, MEAN) / count;
        now[CONTRAST] = (at(LEFT, CONTRAST) - now[MEAN] * shape) / at(CONTRAST, CONTRAST);
        return add_up(now);
    }

    double at(int row, int column) const { return normal_.data()[STRIDE * row + column]; }

    // Adds up the equations of the residuals at `now`; returns the sum of squares.
    double add_up(const double* now) {
        double* own[SIZE + 1];
        for (int k = 0; k <= SIZE; ++k) own[k] = rows_[k].value;
        std::fill(normal_.begin(), normal_.end(), 0.0);
        for (size_t start = 0; start < many_; start += CHUNK) {
            const int n = static_cast<int>(std::min<size_t>(many_ - start, CHUNK) + LANES - 1) / LANES * LANES;
            differentiate(start, n, now);
            find_products(own, SIZE + 1, n, products_);
            for (int k = 0; k <= SIZE; ++k)
                for (int j = 0; j <= k; ++j) normal_.data()[STRIDE * k + j] += products_[STRIDE * k + j];
        }
        return at(LEFT, LEFT);
    }

    // Computes the rows of n pixels, a multiple of LANES: derivatives of the model, and the residuals.
    void differentiate(size_t start, int n, const double* now) {
        const double *x = x_.data() + start, *y = y_.data() + start, *level = level_.data() + start;
        const double *weight = weight_.data() + start, at_x = now[X], at_y = now[Y];
        const double sharp = now[SHARP], c1 = std::cos(now[ANGLE]), s1 = std::sin(now[ANGLE]);
        const double c2 = std::cos(now[ANGLE + 1]), s2 = std::sin(now[ANGLE + 1]), b1 = bend_[0], b2 = bend_[1];
        const double mean = now[MEAN], mean_x = now[MEAN_X], mean_y = now[MEAN_Y];
        const double contrast = now[CONTRAST], contrast_x = now[CONTRAST_X], contrast_y = now[CONTRAST_Y];
        each(n, [&](int i) {
            const double dx = x[i] - at_x, dy = y[i] - at_y, w = weight[i];
            const double l1 = c1 * dx + s1 * dy, a1 = c1 * dy - s1 * dx, t1 = b1 * l1;
            const double l2 = c2 * dx + s2 * dy, a2 = c2 * dy - s2 * dx, t2 = b2 * l2;
            const double d1 = a1 - 0.5 * t1 * l1, d2 = a2 - 0.5 * t2 * l2;
            const double e1 = smooth_step(sharp * d1), e2 = smooth_step(sharp * d2), shape = e1 * e2;
            const double here = contrast + contrast_x * dx + contrast_y * dy;
            const double g1 = here * e2 * (1.0 - e1 * e1), g2 = here * e1 * (1.0 - e2 * e2);
            const double by_x = sharp * (g1 * (s1 + t1 * c1) + g2 * (s2 + t2 * c2));
            const double by_y = sharp * (g1 * (t1 * s1 - c1) + g2 * (t2 * s2 - c2));
            rows_[X][i] = w * (by_x - mean_x - contrast_x * shape),
            rows_[Y][i] = w * (by_y - mean_y - contrast_y * shape);
            rows_[ANGLE][i] = -w * sharp * g1 * (l1 + t1 * a1), rows_[ANGLE + 1][i] = -w * sharp * g2 * (l2 + t2 * a2);
            rows_[SHARP][i] = w * (g1 * d1 + g2 * d2);
            rows_[MEAN][i] = w, rows_[MEAN_X][i] = w * dx, rows_[MEAN_Y][i] = w * dy;
            rows_[CONTRAST][i] = w * shape, rows_[CONTRAST_X][i] = w * shape * dx,
            rows_[CONTRAST_Y][i] = w * shape * dy;
            rows_[LEFT][i] = w * (level[i] - mean - mean_x * dx - mean_y * dy - here * shape);
        });
    }

    void factor(double damping) {
        std::copy(normal_.begin(), normal_.end(), products_);
        // The last term keeps a disc without any contrast solvable; its numbers then stay unchanged.
        for (int k = 0; k < SIZE; ++k) products_[(STRIDE + 1) * k] += damping * products_[(STRIDE + 1) * k] + 1e-12;
        cholesky(SIZE, products_, STRIDE, upper_);
    }

    void solve(double damping, double* step) {
        factor(damping);
        for (int k = 0; k < SIZE; ++k) step[k] = at(LEFT, k);
        substitute(SIZE, upper_, step);
    }

    const Picture picture_;
    std::vector<double> x_, y_, level_, weight_, normal_ = std::vector<double>(STRIDE * STRIDE), kept_ = normal_;
    size_t many_ = 0;
    double bend_[2], products_[STRIDE * STRIDE], upper_[SIZE * SIZE];
    Lane rows_[SIZE + 1];
};

}  // namespace ceres_cal
