// The paper's lens: see radial.py. Form: the index of p1 in the intrinsics (0 for none), then the powers.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "lens.hpp"

namespace ceres_cal {

class Radial final : public Lens {
  public:
    explicit Radial(const Making& from)
        : Lens(from),
          powers_(from.form.values + 1, from.form.values + from.form.count),
          tangential_(static_cast<int>(from.form[0])) {
        for (const double power : powers_)
            if (!(power >= 2.0 && power <= MOST)) throw std::invalid_argument("radial: powers are 2 to 64");
        dense_.assign(powers_.empty() ? 1 : static_cast<size_t>(*std::max_element(powers_.begin(), powers_.end())),
                      0.0);
        dense_[0] = 1.0;
        for (size_t k = 0; k < powers_.size(); ++k)
            dense_[static_cast<size_t>(powers_[k]) - 1] += from.intrinsics[4 + static_cast<int>(k)];
        if (tangential_ > 0) across_ = {from.intrinsics[tangential_], from.intrinsics[tangential_ + 1]};
        // In the worst direction the decentring reduces the radius by 3 |p| r^2.
        std::vector<double> worst = dense_;
        worst.resize(std::max<size_t>(2, worst.size()));
        worst[1] -= 3.0 * std::hypot(across_.p1, across_.p2) * unit / phi;
        limit_ = growing_until(worst.data(), static_cast<int>(worst.size()), FAR, FAR);
    }

    // Solves s (1 + c_2 s + ...) = phi |u| / unit for the radius s, in half image diagonals; a decentring then moves
    // the measured point.
    bool distort(int n, const Rays& rays, Image& image) override {
        each(n, [&](int i) {
            const double iz = 1.0 / rays.z[i], u = rays.x[i] * iz, v = rays.y[i] * iz;
            const double m = std::sqrt(u * u + v * v) + TINY;
            u_[i] = u, v_[i] = v;
            ideal_[i] = phi * m / unit;
            s_[i] = std::min(ideal_[i], limit_);
        });
        double worst = 1.0;
        for (int step = 0; step < STEPS && !(worst < CLOSE); ++step) worst = newton_step(n);
        // At the radius where the map folds, a decentring could lead inwards or past the fold.
        const double inside = tangential_ > 0 ? 0.99 * limit_ : limit_;
        each(n, [&](int i) {
            s_[i] = std::min(s_[i], inside);
            const double stretch = phi * s_[i] / ideal_[i];
            x_[i] = stretch * u_[i], y_[i] = stretch * v_[i];
        });
        invert(n);
        for (int step = 0; tangential_ > 0 && step < STEPS && (step == 0 || !(worst < CLOSE)); ++step)
            worst = move(n), evaluate(n), invert(n);
        int bad = worst < CLOSE ? 0 : 1;
        each(n, [&](int i) {
            const double z = rays.z[i], scale = phi / z;
            const double xx = scale * xx_[i], xy = scale * xy_[i], yy = scale * yy_[i];
            image.x[i] = x_[i], image.y[i] = y_[i];
            image.xx[i] = xx, image.xy[i] = xy, image.yx[i] = xy, image.yy[i] = yy;
            image.xz[i] = -(xx * u_[i] + xy * v_[i]), image.yz[i] = -(xy * u_[i] + yy * v_[i]);
            bad += !((z > 0.0) & (slope_[i] > 0.0) & (s_[i] < limit_));
        });
        return bad == 0;
    }

    void differentiate(const Rows& rows) override {
        const int n = rows.n;
        const Decentring across = across_;
        fill(n, rows.x(0), rows.y(0), [&](int i, double& x, double& y) {
            const double a = x_[i] / phi, b = y_[i] / phi;
            x = u_[i] - across.x(a, b), y = v_[i] - across.y(a, b);
        });
        for (size_t k = 0; k < powers_.size(); ++k) {
            const int row = 4 + static_cast<int>(k), power = static_cast<int>(powers_[k]);
            double* first = rows.show(row);
            fill(n, first, rows.y(row), [&](int i, double& x, double& y) {
                double d = -1.0;
                for (int j = 1; j < power; ++j) d *= s_[i];
                x = d * x_[i], y = d * y_[i];
            });
        }
        for (int k = 0; tangential_ > 0 && k < 2; ++k) {
            const Decentring one = {k == 0 ? phi : 0.0, k == 1 ? phi : 0.0};
            double* first = rows.show(tangential_ + k);
            fill(n, first, rows.y(tangential_ + k), [&](int i, double& x, double& y) {
                const double a = x_[i] / phi, b = y_[i] / phi;
                x = one.x(a, b), y = one.y(a, b);
            });
        }
    }

  private:
    static constexpr double FAR = 6.0;     // half image diagonals: nothing is observed farther out
    static constexpr double CLOSE = 1e-8;  // Newton's last step: the error is of the order of its square
    static constexpr int STEPS = 25, MOST = 64;

    // The derivatives of the ideal point by the measured one, which are symmetric, and their inverse.
    void invert(int n) {
        const Decentring across = across_;
        each(n, [&](int i) {
            const double a = x_[i] / phi, b = y_[i] / phi, per = 1.0 / (a * a + b * b + TINY);
            const double bend = (slope_[i] - value_[i]) * per;
            const double xx = value_[i] + bend * a * a - across.xx(a, b), xy = bend * a * b - across.xy(a, b);
            const double yy = value_[i] + bend * b * b - across.yy(a, b), area = 1.0 / (xx * yy - xy * xy);
            xx_[i] = yy * area, xy_[i] = -xy * area, yy_[i] = xx * area;
        });
    }

    // One Newton step of the measured point towards x (d_0 + d_1 s + ...) - its decentring = ideal. Returns the largest
    // step, in half image diagonals.
    double move(int n) {
        const Decentring across = across_;
        const double longest = 0.1 * limit_;  // at the fold the map hardly grows, and a full step would end behind it
        double worst = 0.0;
        each(n, [&](int i) {
            const double a = x_[i] / phi, b = y_[i] / phi;
            const double left = phi * (a * value_[i] - across.x(a, b) - u_[i]);
            const double down = phi * (b * value_[i] - across.y(a, b) - v_[i]);
            const double dx = xx_[i] * left + xy_[i] * down, dy = xy_[i] * left + yy_[i] * down;
            const double length = std::sqrt(dx * dx + dy * dy) / unit + TINY, part = std::min(1.0, longest / length);
            worst = std::max(worst, length);
            x_[i] -= part * dx, y_[i] -= part * dy;
            s_[i] = std::min(std::sqrt(x_[i] * x_[i] + y_[i] * y_[i]) / unit, limit_);
        });
        return worst;
    }

    // Fills rows of derivatives of the measured point, from those of the ideal point, which `by` gives.
    template <class By>
    void fill(int n, double* x, double* y, By by) {
        each(n, [&](int i) {
            double a, b;
            by(i, a, b);
            x[i] = xx_[i] * a + xy_[i] * b, y[i] = aspect * (xy_[i] * a + yy_[i] * b);
        });
    }

    // value = d_0 + d_1 s + ..., and slope = d/ds of s times that.
    void evaluate(int n) {
        const int top = static_cast<int>(dense_.size()) - 1;
        const double* dense = dense_.data();
        each(n, [&](int i) { value_[i] = dense[top], slope_[i] = (top + 1) * dense[top]; });
        for (int k = top - 1; k >= 0; --k) {
            const double d = dense[k], e = (k + 1) * dense[k];
            each(n, [&](int i) { value_[i] = value_[i] * s_[i] + d, slope_[i] = slope_[i] * s_[i] + e; });
        }
    }

    // One Newton step of s towards s (d_0 + d_1 s + ...) = ideal. Returns the largest step.
    double newton_step(int n) {
        evaluate(n);
        double worst = 0.0;
        each(n, [&](int i) {
            const double s = s_[i];
            const double moved = std::max(0.0, std::min(s - (value_[i] * s - ideal_[i]) / slope_[i], limit_));
            worst = std::max(worst, std::abs(moved - s));
            s_[i] = moved;
        });
        return worst;
    }

    std::vector<double> powers_, dense_;
    int tangential_;
    Decentring across_;
    double limit_ = 0.0;
    Lane u_, v_, ideal_, s_, value_, slope_, x_, y_, xx_, xy_, yy_;
};

}  // namespace ceres_cal
