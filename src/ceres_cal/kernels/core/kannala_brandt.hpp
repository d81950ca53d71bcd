// Kannala and Brandt's lens: see kannala_brandt.py. Form: the place of p1 among the intrinsics, 0 for none.
#pragma once

#include <cmath>

#include "growing.hpp"
#include "lens.hpp"

namespace ceres_cal {

class KannalaBrandt final : public Lens {
  public:
    explicit KannalaBrandt(const Making& from)
        : phi_(from.intrinsics[0]), aspect_(from.intrinsics[1]), tangential_(static_cast<int>(from.form[0])) {
        for (int j = 0; j < 4; ++j) k_[j] = from.intrinsics[4 + j];
        if (tangential_ > 0) p1_ = from.intrinsics[tangential_], p2_ = from.intrinsics[tangential_ + 1];
        const double dense[9] = {1.0, 0.0, k_[0], 0.0, k_[1], 0.0, k_[2], 0.0, k_[3]};
        limit_ = growing_until(dense, 9, PI, PI);
    }

    bool distort(int n, const Rays& rays, Image& image) override {
        const double phi = phi_, k1 = k_[0], k2 = k_[1], k3 = k_[2], k4 = k_[3];
        each(n, [&](int i) { across_[i] = std::sqrt(rays.x[i] * rays.x[i] + rays.y[i] * rays.y[i]) + TINY; });
        for (int i = 0; i < n; ++i) angle_[i] = std::atan2(across_[i], rays.z[i]);
        int bad = 0;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], across = across_[i], angle = angle_[i];
            const double across2 = x * x + y * y, range2 = across2 + z * z, a2 = angle * angle;
            const double measured = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
            const double slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
            // On the axis measured / across is 1 / z, and the bend's factor x^2 takes it to 0.
            const bool aside = across > 1e-12 * z;
            const double off = measured / across, on = 1.0 / z, stretch = aside ? off : on;
            const double turn = (slope * z / range2 - stretch) / (across2 + TINY), bend = aside ? turn : 0.0;
            image.x[i] = phi * stretch * x, image.y[i] = phi * stretch * y;
            image.xx[i] = phi * (stretch + bend * x * x), image.yy[i] = phi * (stretch + bend * y * y);
            image.xy[i] = phi * bend * x * y, image.yx[i] = phi * bend * x * y;
            image.xz[i] = -phi * x * slope / range2, image.yz[i] = -phi * y * slope / range2;
            cos_[i] = x / across, sin_[i] = y / across;
            bad += !((angle < limit_) & (range2 > 0.0));
        });
        if (tangential_ > 0) add_tangential(n, rays, image);
        return bad == 0;
    }

    void differentiate(const Rows& rows) override {
        const double phi = phi_, aspect = aspect_;
        double *x[4], *y[4];
        for (int k = 0; k < 4; ++k) x[k] = rows.x(4 + k), y[k] = rows.y(4 + k), rows.shown[4 + k] = true;
        each(rows.n, [&](int i) {
            const double a2 = angle_[i] * angle_[i];
            double d = phi * a2 * angle_[i];
            for (int k = 0; k < 4; ++k, d *= a2) x[k][i] = d * cos_[i], y[k][i] = aspect * d * sin_[i];
        });
        if (tangential_ <= 0) return;
        for (int k = 0; k < 2; ++k)
            x[k] = rows.x(tangential_ + k), y[k] = rows.y(tangential_ + k), rows.shown[tangential_ + k] = true;
        each(rows.n, [&](int i) {
            const double a = angle_[i] * cos_[i], b = angle_[i] * sin_[i];
            x[0][i] = 2.0 * phi * a * b, y[0][i] = aspect * phi * (a * a + 3.0 * b * b);
            x[1][i] = phi * (3.0 * a * a + b * b), y[1][i] = 2.0 * aspect * phi * a * b;
        });
    }

  private:
    static constexpr double PI = 3.14159265358979323846;

    void add_tangential(int n, const Rays& rays, Image& image) {
        const double phi = phi_, p1 = p1_, p2 = p2_;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], across = across_[i];
            const double across2 = x * x + y * y, range2 = across2 + z * z;
            const bool aside = across > 1e-12 * z;
            const double off = angle_[i] / across, on = 1.0 / z, away = aside ? off : on;
            const double turn = (z / range2 - away) / (across2 + TINY), bend = aside ? turn : 0.0;
            const double a = away * x, b = away * y;
            const double ax = away + bend * x * x, ab = bend * x * y, by = away + bend * y * y;
            const double xx = 2.0 * p1 * b + 6.0 * p2 * a, xy = 2.0 * p1 * a + 2.0 * p2 * b,
                         yy = 6.0 * p1 * b + 2.0 * p2 * a;
            image.x[i] += phi * (2.0 * p1 * a * b + p2 * (3.0 * a * a + b * b));
            image.y[i] += phi * (p1 * (a * a + 3.0 * b * b) + 2.0 * p2 * a * b);
            image.xx[i] += phi * (xx * ax + xy * ab), image.xy[i] += phi * (xx * ab + xy * by);
            image.yx[i] += phi * (xy * ax + yy * ab), image.yy[i] += phi * (xy * ab + yy * by);
            image.xz[i] -= phi * (xx * x + xy * y) / range2, image.yz[i] -= phi * (xy * x + yy * y) / range2;
        });
    }

    double phi_, aspect_, k_[4], p1_ = 0.0, p2_ = 0.0, limit_ = 0.0;
    int tangential_;
    Lane across_, angle_, cos_, sin_;
};

}  // namespace ceres_cal
