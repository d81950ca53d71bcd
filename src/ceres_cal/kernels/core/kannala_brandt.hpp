// Kannala and Brandt's lens: see opencv.py. Form: the index of p1 in the intrinsics, 0 for none.
#pragma once

#include <cmath>

#include "lens.hpp"

namespace ceres_cal {

class KannalaBrandt final : public Lens {
  public:
    explicit KannalaBrandt(const Making& from) : Lens(from), tangential_(static_cast<int>(from.form[0])) {
        for (int j = 0; j < 4; ++j) k_[j] = from.intrinsics[4 + j];
        if (tangential_ > 0) decentring_ = {from.intrinsics[tangential_], from.intrinsics[tangential_ + 1]};
        const double dense[9] = {1.0, 0.0, k_[0], 0.0, k_[1], 0.0, k_[2], 0.0, k_[3]};
        limit_ = growing_until(dense, 9, PI, PI);
    }

    bool distort(int n, const Rays& rays, Image& image) override {
        return tangential_ > 0 ? distort_by<true>(n, rays, image) : distort_by<false>(n, rays, image);
    }

    void differentiate(const Rows& rows) override {
        const double phi = this->phi, aspect = this->aspect;
        double *x[4], *y[4];
        for (int k = 0; k < 4; ++k) x[k] = rows.show(4 + k), y[k] = rows.y(4 + k);
        each(rows.n, [&](int i) {
            const double a2 = angle_[i] * angle_[i];
            double d = phi * a2 * angle_[i];
            for (int k = 0; k < 4; ++k, d *= a2) x[k][i] = d * cos_[i], y[k][i] = aspect * d * sin_[i];
        });
        if (tangential_ > 0) differentiate_decentring(rows, tangential_, along_x_, along_y_);
    }

  private:
    static constexpr double PI = 3.14159265358979323846;

    // For a length along the meridian and its derivative by the distance across: its components in x and y are
    // `stretch` times x and y, with the derivatives stretch + bend x^2, bend x y ... On the axis the stretch is 1 / z,
    // and x^2 makes the bend irrelevant.
    struct Meridian {
        double stretch, bend;
    };
    static Meridian along_meridian(double length, double slope, double across, double across2, double z) {
        const bool aside = across > 1e-12 * z;
        const double off = length / across, on = 1.0 / z, stretch = aside ? off : on;
        const double turn = (slope - stretch) / (across2 + TINY);
        return {stretch, aside ? turn : 0.0};
    }

    template <bool decentred>
    bool distort_by(int n, const Rays& rays, Image& image) {
        const double phi = this->phi, k1 = k_[0], k2 = k_[1], k3 = k_[2], k4 = k_[3];
        const Decentring by = decentring_;
        each(n, [&](int i) { across_[i] = std::sqrt(rays.x[i] * rays.x[i] + rays.y[i] * rays.y[i]) + TINY; });
        for (int i = 0; i < n; ++i) angle_[i] = std::atan2(across_[i], rays.z[i]);
        int bad = 0;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], across = across_[i], angle = angle_[i];
            const double across2 = x * x + y * y, range2 = across2 + z * z, a2 = angle * angle;
            const double measured = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
            const double slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
            const auto [stretch, bend] = along_meridian(measured, slope * z / range2, across, across2, z);
            double to_x = stretch * x, to_y = stretch * y, far = slope / range2, xz = far * x, yz = far * y;
            double xx = stretch + bend * x * x, xy = bend * x * y, yx = xy, yy = stretch + bend * y * y;
            if constexpr (decentred) {
                const auto [away, turn] = along_meridian(angle, z / range2, across, across2, z);
                const double a = along_x_[i] = away * x, b = along_y_[i] = away * y;
                const double ax = away + turn * x * x, ab = turn * x * y, bb = away + turn * y * y;
                const double by_xx = by.xx(a, b), by_xy = by.xy(a, b), by_yy = by.yy(a, b);
                to_x += by.x(a, b), xx += by_xx * ax + by_xy * ab, xz += (by_xx * x + by_xy * y) / range2;
                to_y += by.y(a, b), yy += by_xy * ab + by_yy * bb, yz += (by_xy * x + by_yy * y) / range2;
                xy += by_xx * ab + by_xy * bb, yx += by_xy * ax + by_yy * ab;
            }
            image.x[i] = phi * to_x, image.xx[i] = phi * xx, image.xy[i] = phi * xy, image.xz[i] = -phi * xz;
            image.y[i] = phi * to_y, image.yx[i] = phi * yx, image.yy[i] = phi * yy, image.yz[i] = -phi * yz;
            cos_[i] = x / across, sin_[i] = y / across;
            bad += !((angle < limit_) & (range2 > 0.0));
        });
        return bad == 0;
    }

    double k_[4], limit_ = 0.0;
    Decentring decentring_;
    int tangential_;
    Lane across_, angle_, cos_, sin_, along_x_, along_y_;
};

}  // namespace ceres_cal
