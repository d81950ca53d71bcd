// A camera's optics: its lens under phi, aspect, principal point and skew.
#pragma once

#include <memory>

#include "lens.hpp"

namespace ceres_cal {

class Optics {
  public:
    // intrinsics: phi, aspect, cx, cy, scaled coefficients, skew; the caller keeps them.
    Optics(std::unique_ptr<Lens> lens, const double* intrinsics, int count)
        : count(count),
          phi(intrinsics[0]),
          aspect(intrinsics[1]),
          cx(intrinsics[2]),
          cy(intrinsics[3]),
          lens_(std::move(lens)),
          skew_(intrinsics[count - 1]) {}

    const int count;
    const double phi, aspect, cx, cy;

    // Of the first n rays; false where any has no answer. A skew of the pixels leans the lens's own image.
    bool distort(int n, const Rays& rays, Image& image) const {
        const bool good = lens_->distort(n, rays, image);
        if (skew_ != 0.0)
            each(n, [&](int i) {
                image.x[i] += skew_ * image.y[i];
                image.xx[i] += skew_ * image.yx[i];
                image.xy[i] += skew_ * image.yy[i];
                image.xz[i] += skew_ * image.yz[i];
            });
        return good;
    }

    // Derivatives of the distorted chunk's pixels by phi, aspect, principal point, coefficients and skew.
    void differentiate(const Image& image, const Rows& rows) const {
        const int n = rows.n, last = count - 1;
        for (int k = 0; k < count; ++k) rows.shown[k] = k < 4 || k == last;
        double *by_phi = rows.x(0), *by_aspect = rows.x(1), *by_cx = rows.x(2), *by_cy = rows.x(3),
               *by_skew = rows.x(last);
        each(n, [&](int i) {
            by_phi[i] = (image.x[i] - skew_ * image.y[i]) / phi, by_phi[n + i] = aspect * image.y[i] / phi;
            by_aspect[i] = 0.0, by_aspect[n + i] = image.y[i];
            by_cx[i] = 1.0, by_cx[n + i] = 0.0, by_cy[i] = 0.0, by_cy[n + i] = 1.0;
            by_skew[i] = image.y[i], by_skew[n + i] = 0.0;
        });
        lens_->differentiate(rows);
        for (int k = 0; k < last && skew_ != 0.0; ++k) {
            if (!rows.shown[k] || (k >= 1 && k <= 3)) continue;
            double* own = rows.x(k);
            each(n, [&](int i) { own[i] += skew_ / aspect * own[n + i]; });
        }
    }

  private:
    std::unique_ptr<Lens> lens_;
    double skew_;
};

}  // namespace ceres_cal
