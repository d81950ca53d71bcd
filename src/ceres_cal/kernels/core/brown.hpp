// Brown's lens as in OpenCV: see opencv.py. Form: the indices of k4 and s1 in the intrinsics, 0 for none.
#pragma once

#include <algorithm>

#include "lens.hpp"

namespace ceres_cal {

class Brown final : public Lens {
  public:
    explicit Brown(const Making& from)
        : Lens(from),
          by_{from.intrinsics[6], from.intrinsics[7]},
          rational_(static_cast<int>(from.form[0])),
          prism_(static_cast<int>(from.form[1])) {
        const Numbers& intrinsics = from.intrinsics;
        k_[1] = intrinsics[4], k_[2] = intrinsics[5], k_[3] = intrinsics[8];
        for (int j = 0; j < 3; ++j) q_[1 + j] = rational_ > 0 ? intrinsics[rational_ + j] : 0.0;
        for (int j = 0; j < 4; ++j) s_[j] = prism_ > 0 ? intrinsics[prism_ + j] : 0.0;
        // Polynomials u (d_0 + d_1 u + ...) whose slopes are the radial slope times q^2, and the denominator q.
        double rising[13] = {}, under[7] = {};
        for (int j = 0; j < 4; ++j) {
            under[2 * j] = q_[j] / (2.0 * j + 1.0);
            for (int i = 0; i < 4; ++i)
                rising[2 * (j + i)] += k_[j] * q_[i] * (2.0 * j + 1.0 - 2.0 * i) / (2.0 * (j + i) + 1.0);
        }
        limit_ = std::min(growing_until(rising, 13, FAR, FARTHEST), growing_until(under, 7, FAR, FARTHEST));
    }

    bool distort(int n, const Rays& rays, Image& image) override {
        const double phi = this->phi, p1 = by_.p1, p2 = by_.p2, k1 = k_[1], k2 = k_[2], k3 = k_[3], k4 = q_[1],
                     k5 = q_[2], k6 = q_[3], s1 = s_[0], s2 = s_[1], s3 = s_[2], s4 = s_[3], limit2 = limit_ * limit_;
        int bad = 0;
        each(n, [&](int i) {
            const double z = rays.z[i], iz = 1.0 / z, u = rays.x[i] * iz, v = rays.y[i] * iz, r2 = u * u + v * v;
            const double below = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
            const double radial = below * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)));
            const double bend =
                2.0 * below * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)));
            const double first = 2.0 * (s1 + 2.0 * r2 * s2), second = 2.0 * (s3 + 2.0 * r2 * s4);
            const double both = u * v * bend + 2.0 * p1 * u + 2.0 * p2 * v, scale = phi * iz;
            const double xx = scale * (radial + u * u * bend + 2.0 * p1 * v + 6.0 * p2 * u + first * u);
            const double xy = scale * (both + first * v), yx = scale * (both + second * u);
            const double yy = scale * (radial + v * v * bend + 6.0 * p1 * v + 2.0 * p2 * u + second * v);
            image.x[i] = phi * (u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u) + r2 * (s1 + r2 * s2));
            image.y[i] = phi * (v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v + r2 * (s3 + r2 * s4));
            image.xx[i] = xx, image.xy[i] = xy, image.yx[i] = yx, image.yy[i] = yy;
            image.xz[i] = -(xx * u + xy * v), image.yz[i] = -(yx * u + yy * v);
            u_[i] = u, v_[i] = v, r2_[i] = r2, below_[i] = below, radial_[i] = radial;
            bad += !((z > 0.0) & (r2 < limit2));
        });
        return bad == 0;
    }

    void differentiate(const Rows& rows) override {
        const double phi = this->phi, aspect = this->aspect;
        const int n = rows.n;
        double *x[3], *y[3];
        for (int k = 0; k < 3; ++k) x[k] = rows.show(k == 2 ? 8 : 4 + k), y[k] = x[k] + n;
        each(n, [&](int i) {
            double power = below_[i] * phi;
            for (int k = 0; k < 3; ++k) power *= r2_[i], x[k][i] = power * u_[i], y[k][i] = aspect * power * v_[i];
        });
        differentiate_decentring(rows, 6, u_, v_);
        for (int k = 0; k < 3 && rational_ > 0; ++k) {
            double* own = rows.show(rational_ + k);  // k1, k2 and k3 have the same powers in the numerator
            each(n, [&](int i) { own[i] = -radial_[i] * x[k][i], own[n + i] = -radial_[i] * y[k][i]; });
        }
        for (int k = 0; k < 4 && prism_ > 0; ++k) {
            rows.open(prism_ + k);
            double* own = k < 2 ? rows.x(prism_ + k) : rows.y(prism_ + k);
            const double scale = k < 2 ? phi : aspect * phi;
            each(n, [&](int i) { own[i] = scale * r2_[i] * (k % 2 == 1 ? r2_[i] : 1.0); });
        }
    }

  private:
    static constexpr double FAR = 6.0, FARTHEST = 1e4;  // ideal radii, at 80.5 and 89.994 degrees from the axis

    Decentring by_;
    double k_[4] = {1.0}, q_[4] = {1.0}, s_[4] = {}, limit_ = 0.0;
    int rational_, prism_;
    Lane u_, v_, r2_, below_, radial_;
};

}  // namespace ceres_cal
