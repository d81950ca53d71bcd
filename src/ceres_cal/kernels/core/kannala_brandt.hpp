// Kannala and Brandt's lens: see kannala_brandt.py. Form: the place of p1 among the intrinsics, 0 for none.
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
        const double phi = this->phi, k1 = k_[0], k2 = k_[1], k3 = k_[2], k4 = k_[3];
        each(n, [&](int i) { across_[i] = std::sqrt(rays.x[i] * rays.x[i] + rays.y[i] * rays.y[i]) + TINY; });
        for (int i = 0; i < n; ++i) angle_[i] = std::atan2(across_[i], rays.z[i]);
        int bad = 0;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], across = across_[i], angle = angle_[i];
            const double across2 = x * x + y * y, range2 = across2 + z * z, a2 = angle * angle;
            const double measured = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))));
            const double slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)));
            const auto [stretch, bend] = along_meridian(measured, slope * z / range2, across, across2, z);
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
        const double phi = this->phi, aspect = this->aspect;
        double *x[4], *y[4];
        for (int k = 0; k < 4; ++k) x[k] = rows.show(4 + k), y[k] = rows.y(4 + k);
        each(rows.n, [&](int i) {
            const double a2 = angle_[i] * angle_[i];
            double d = phi * a2 * angle_[i];
            for (int k = 0; k < 4; ++k, d *= a2) x[k][i] = d * cos_[i], y[k][i] = aspect * d * sin_[i];
        });
        if (tangential_ <= 0) return;
        for (int k = 0; k < 2; ++k) {
            const Decentring one = {k == 0 ? phi : 0.0, k == 1 ? phi : 0.0};
            x[k] = rows.show(tangential_ + k), y[k] = rows.y(tangential_ + k);
            each(rows.n, [&](int i) {
                const double a = angle_[i] * cos_[i], b = angle_[i] * sin_[i];
                x[k][i] = one.x(a, b), y[k][i] = aspect * one.y(a, b);
            });
        }
    }

  private:
    static constexpr double PI = 3.14159265358979323846;

    // Of a length along the meridian and its derivative by the distance across: with x and y it is `stretch` times
    // them, whose derivatives are stretch + bend x^2, bend x y ... On the axis the stretch is 1 / z, and x^2 takes the
    // bend to 0.
    struct Meridian {
        double stretch, bend;
    };
    static Meridian along_meridian(double length, double slope, double across, double across2, double z) {
        const bool aside = across > 1e-12 * z;
        const double off = length / across, on = 1.0 / z, stretch = aside ? off : on;
        const double turn = (slope - stretch) / (across2 + TINY);
        return {stretch, aside ? turn : 0.0};
    }

    void add_tangential(int n, const Rays& rays, Image& image) {
        const double phi = this->phi;
        const Decentring by = decentring_;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], across = across_[i];
            const double across2 = x * x + y * y, range2 = across2 + z * z;
            const auto [away, bend] = along_meridian(angle_[i], z / range2, across, across2, z);
            const double a = away * x, b = away * y;
            const double ax = away + bend * x * x, ab = bend * x * y, bb = away + bend * y * y;
            const double xx = by.xx(a, b), xy = by.xy(a, b), yy = by.yy(a, b);
            image.x[i] += phi * by.x(a, b), image.y[i] += phi * by.y(a, b);
            image.xx[i] += phi * (xx * ax + xy * ab), image.xy[i] += phi * (xx * ab + xy * bb);
            image.yx[i] += phi * (xy * ax + yy * ab), image.yy[i] += phi * (xy * ab + yy * bb);
            image.xz[i] -= phi * (xx * x + xy * y) / range2, image.yz[i] -= phi * (xy * x + yy * y) / range2;
        });
    }

    double k_[4], limit_ = 0.0;
    Decentring decentring_;
    int tangential_;
    Lane across_, angle_, cos_, sin_;
};

}  // namespace ceres_cal
