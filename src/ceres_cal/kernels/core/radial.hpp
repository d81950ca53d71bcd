// The paper's lens: see radial.py. Form: the place of p1 among the intrinsics, 0 for none, and its powers.
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
        limit_ = growing_until(dense_.data(), static_cast<int>(dense_.size()), FAR, FAR);
        if (tangential_ > 0) across_ = {from.intrinsics[tangential_], from.intrinsics[tangential_ + 1]};
    }

    // s (1 + c_2 s + ...) = phi |u| / unit solved for the radius s, in half image diagonals.
    bool distort(int n, const Rays& rays, Image& image) override {
        each(n, [&](int i) {
            const double iz = 1.0 / rays.z[i], u = rays.x[i] * iz, v = rays.y[i] * iz;
            const double m = std::sqrt(u * u + v * v) + TINY;
            u_[i] = u, v_[i] = v, m_[i] = m;
            ideal_[i] = phi * m / unit;
            s_[i] = std::min(ideal_[i], limit_);
        });
        double worst = 1.0;
        for (int step = 0; step < STEPS && !(worst < CLOSE); ++step) worst = newton_step(n);
        int bad = worst < CLOSE ? 0 : 1;
        const Decentring across = across_;
        each(n, [&](int i) {
            const double u = u_[i], v = v_[i], m = m_[i], s = s_[i], z = rays.z[i], iz = 1.0 / z;
            const double per_slope = 1.0 / slope_[i];
            const double stretch = unit * s / m;  // px per unit of the ideal point
            const double bend = (phi * per_slope - stretch) / (m * m);
            const double xx = (stretch + bend * u * u + phi * across.xx(u, v)) * iz;
            const double xy = (bend * u * v + phi * across.xy(u, v)) * iz;
            const double yy = (stretch + bend * v * v + phi * across.yy(u, v)) * iz;
            per_slope_[i] = per_slope;
            image.x[i] = stretch * u + phi * across.x(u, v), image.y[i] = stretch * v + phi * across.y(u, v);
            image.xx[i] = xx, image.xy[i] = xy, image.yx[i] = xy, image.yy[i] = yy;
            image.xz[i] = -(xx * u + xy * v), image.yz[i] = -(xy * u + yy * v);
            bad += !((z > 0.0) & (slope_[i] > 0.0) & (s < limit_));
        });
        return bad == 0;
    }

    void differentiate(const Rows& rows) override {
        const int n = rows.n;
        double *x = rows.x(0), *y = rows.y(0);
        const Decentring across = across_;
        each(n, [&](int i) {
            const double u = u_[i], v = v_[i];
            x[i] = u * per_slope_[i] + across.x(u, v), y[i] = aspect * (v * per_slope_[i] + across.y(u, v));
        });
        for (size_t k = 0; k < powers_.size(); ++k) {
            const int row = 4 + static_cast<int>(k), power = static_cast<int>(powers_[k]);
            x = rows.show(row), y = rows.y(row);
            each(n, [&](int i) {
                double d = -unit * per_slope_[i] / m_[i];
                for (int j = 0; j < power; ++j) d *= s_[i];
                x[i] = d * u_[i], y[i] = aspect * d * v_[i];
            });
        }
        if (tangential_ > 0) differentiate_decentring(rows, tangential_, u_, v_);
    }

  private:
    static constexpr double FAR = 6.0;     // half image diagonals: nothing is observed farther out
    static constexpr double CLOSE = 1e-8;  // the step just taken has squared this
    static constexpr int STEPS = 25, MOST = 64;

    // One step from s towards s (d_0 + d_1 s + ...) = ideal; how far the farthest one went.
    double newton_step(int n) {
        const int top = static_cast<int>(dense_.size()) - 1;
        const double* dense = dense_.data();
        each(n, [&](int i) { value_[i] = dense[top], slope_[i] = (top + 1) * dense[top]; });
        for (int k = top - 1; k >= 0; --k) {
            const double d = dense[k], e = (k + 1) * dense[k];
            each(n, [&](int i) { value_[i] = value_[i] * s_[i] + d, slope_[i] = slope_[i] * s_[i] + e; });
        }
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
    Lane u_, v_, m_, ideal_, s_, value_, slope_, per_slope_;
};

}  // namespace ceres_cal
