// A lens as the solve uses it, with the rest of the camera's optics, for one chunk of rays at a time.
#pragma once

#include <algorithm>
#include <stdexcept>

#include "chunk.hpp"

namespace ceres_cal {

// An array with checked access. A lens is made from it; chunks are not checked.
struct Numbers {
    const double* values;
    int count;
    double operator[](int place) const { return *from(place, 1); }
    const double* from(int place, int many) const {
        if (place < 0 || place + many > count) throw std::invalid_argument("a lens has fewer numbers than its kind");
        return values + place;
    }
};

// The data from which a lens is made: `Lens.form` of Python; phi, aspect, cx, cy and the scaled coefficients; skew; and
// half the image diagonal, px.
struct Making {
    Numbers form, intrinsics;
    double skew, unit;
};

// Brown's decentring of a point (a, b): its displacement, and the derivatives of that, which are symmetric.
struct Decentring {
    double p1 = 0.0, p2 = 0.0;
    double x(double a, double b) const { return 2.0 * p1 * a * b + p2 * (3.0 * a * a + b * b); }
    double y(double a, double b) const { return p1 * (a * a + 3.0 * b * b) + 2.0 * p2 * a * b; }
    double xx(double a, double b) const { return 2.0 * p1 * b + 6.0 * p2 * a; }
    double xy(double a, double b) const { return 2.0 * p1 * a + 2.0 * p2 * b; }
    double yy(double a, double b) const { return 6.0 * p1 * b + 2.0 * p2 * a; }
};

// A lens with phi, aspect, principal point and skew.
class Lens {
  public:
    explicit Lens(const Making& from)
        : count(from.intrinsics.count + 1),
          phi(from.intrinsics[0]),
          aspect(from.intrinsics[1]),
          cx(from.intrinsics[2]),
          cy(from.intrinsics[3]),
          skew(from.skew),
          unit(from.unit) {}
    Lens(const Lens&) = delete;
    Lens& operator=(const Lens&) = delete;
    virtual ~Lens() = default;

    const int count;  // number of the intrinsics, with the skew last
    const double phi, aspect, cx, cy, skew, unit;

    // Projects the first n rays; returns false if any has no image. A skew of the pixels shears the lens's own image.
    bool project(int n, const Rays& rays, Image& image) {
        const bool good = distort(n, rays, image);
        if (skew != 0.0)
            each(n, [&](int i) {
                image.x[i] += skew * image.y[i];
                image.xx[i] += skew * image.yx[i];
                image.xy[i] += skew * image.yy[i];
                image.xz[i] += skew * image.yz[i];
            });
        return good;
    }

    // Fills derivatives of the last projected pixels by phi, aspect, principal point, coefficients and skew.
    void fill(const Image& image, const Rows& rows) {
        const int n = rows.n, last = count - 1;
        for (int k = 0; k < count; ++k) rows.shown[k] = k < 4 || k == last;
        double *by_phi = rows.x(0), *by_aspect = rows.x(1), *by_cx = rows.x(2), *by_cy = rows.x(3),
               *by_skew = rows.x(last);
        each(n, [&](int i) {
            by_phi[i] = (image.x[i] - skew * image.y[i]) / phi, by_phi[n + i] = aspect * image.y[i] / phi;
            by_aspect[i] = 0.0, by_aspect[n + i] = image.y[i];
            by_cx[i] = 1.0, by_cx[n + i] = 0.0, by_cy[i] = 0.0, by_cy[n + i] = 1.0;
            by_skew[i] = image.y[i], by_skew[n + i] = 0.0;
        });
        differentiate(rows);
        for (int k = 0; k < last && skew != 0.0; ++k) {
            if (!rows.shown[k] || (k >= 1 && k <= 3)) continue;
            double* own = rows.x(k);
            each(n, [&](int i) { own[i] += skew / aspect * own[n + i]; });
        }
    }

  protected:
    // Fills the first n entries of the image; returns false if any ray has no image.
    virtual bool distort(int n, const Rays& rays, Image& image) = 0;

    // Fills, for the rays that were distorted last, rows 4 and up: the derivatives of the pixel's x and y (its y is
    // aspect times the offset's) by each coefficient in the solver's unit; and row 0, that of phi, if the offset is not
    // proportional to phi. It marks the rows that it fills.
    virtual void differentiate(const Rows& rows) = 0;

    // Fills the rows of Brown's decentring of the points (a, b), from row `at` on.
    void differentiate_decentring(const Rows& rows, int at, const Lane& a, const Lane& b) const {
        for (int k = 0; k < 2; ++k) {
            const Decentring one = {k == 0 ? phi : 0.0, k == 1 ? phi : 0.0};
            double *x = rows.show(at + k), *y = rows.y(at + k);
            each(rows.n, [&](int i) { x[i] = one.x(a[i], b[i]), y[i] = aspect * one.y(a[i], b[i]); });
        }
    }
};

constexpr double TINY = 1e-150;  // its square can still be represented

// d/dx of x (d_0 + d_1 x + d_2 x^2 ...).
inline double radial_slope(const double* dense, int count, double x) {
    double total = 0.0;
    for (int k = count - 1; k >= 0; --k) total = total * x + (k + 1) * dense[k];
    return total;
}

// The place where x (d_0 + d_1 x + d_2 x^2 ...) stops growing, or `farthest`, the largest observable one. It is
// searched in equal steps up to `far`, and in growing steps beyond.
inline double growing_until(const double* dense, int count, double far, double farthest) {
    constexpr int STEPS = 96, HALVINGS = 50;
    constexpr double GROWTH = 1.1;
    double low = 0.0, high = far / STEPS;
    while (radial_slope(dense, count, high) > 0.0) {
        if (high >= farthest) return farthest;
        low = high;
        high = std::min(high < far ? high + far / STEPS : GROWTH * high, farthest);
    }
    for (int i = 0; i < HALVINGS; ++i) {
        const double middle = 0.5 * (low + high);
        (radial_slope(dense, count, middle) > 0.0 ? low : high) = middle;
    }
    return low;
}

}  // namespace ceres_cal
