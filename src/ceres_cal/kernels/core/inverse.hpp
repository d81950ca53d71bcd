// Inverses: of a growing map along a radius, and of a lens, by Newton's method. See `scene/lens/planar.py`.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "lens.hpp"

namespace ceres_cal {

// A map of consecutive polynomials, each over an interval of the same width and in terms of the position in it from 0
// to 1, the last one without an end; divided by another polynomial, if there is one.
class MonotonicMap {
  public:
    MonotonicMap(int pieces, int terms, const double* above, double width, int terms_below, const double* below,
                 double limit)
        : pieces_(pieces),
          terms_(terms),
          terms_below_(terms_below),
          above_(above),
          below_(below),
          share_(1.0 / width),
          limit_(limit),
          end_(limit < FAR ? at(limit).value : FAR) {}

    // x up to the limit where the map equals `target`, by Newton's method from a start, and bisection; NaN if there is
    // none.
    double inverse(double target, double start) const {
        constexpr double NONE = std::numeric_limits<double>::quiet_NaN();
        if (!(target >= 0.0 && target < FAR && target <= end_)) return NONE;
        double low = 0.0, high = limit_ < FAR ? limit_ : target, last = FAR;
        if (!(limit_ < FAR)) {
            for (int i = 0; i < STEPS && at(high).value < target; ++i) high *= 2.0;
            if (!(target <= at(high).value)) return NONE;
        }
        double x = std::clamp(start, low, high);
        for (int i = 0; i < STEPS; ++i) {
            const Value there = at(x);
            const double error = there.value - target;
            if (error < 0.0) low = x;
            if (error > 0.0) high = x;
            double move = -error / there.slope;
            // Steps that do not halve the last one may run in a circle.
            const bool good = x + move >= low && x + move <= high && std::abs(move) <= 0.5 * last;
            if (!good) move = 0.5 * (low + high) - x;
            if (!(std::abs(error) > 1e-15 * target)) move = 0.0;
            last = std::abs(move);
            x += move;
            if (!(last > 1e-13 * x)) return x;
        }
        return NONE;
    }

  private:
    static constexpr double FAR = std::numeric_limits<double>::infinity();
    static constexpr int STEPS = 60;  // a safeguard: Newton needs 4 to 8, bisection 53
    struct Value {
        double value, slope;
    };

    static Value polynomial(int terms, const double* of, double x) {
        Value found{of[terms - 1], 0.0};
        for (int k = terms - 2; k >= 0; --k) {
            found.slope = found.slope * x + found.value;
            found.value = found.value * x + of[k];
        }
        return found;
    }

    Value at(double x) const {
        const double place = x * share_;
        const int piece = place < pieces_ - 1 ? static_cast<int>(place) : pieces_ - 1;
        Value found = polynomial(terms_, above_ + terms_ * piece, place - piece);
        found.slope *= share_;
        if (terms_below_ == 0) return found;
        const Value below = polynomial(terms_below_, below_, x);
        found.value /= below.value;
        found.slope = (found.slope - found.value * below.slope) / below.value;
        return found;
    }

    int pieces_, terms_, terms_below_;
    const double *above_, *below_;
    double share_, limit_, end_;  // 1 / width; the limit; the value of the map at its limit
};

// Rays of a lens on square pixels from their offsets. Each is searched in the plane that touches the sphere at its
// start.
class RaySearch {
  public:
    // Moves the n rays (x, y, z), unit vectors at first, to the offsets (x, y), in steps of at most `longest` radians;
    // NaN for rays without convergence.
    void find(Lens& lens, int n, const double* offsets, double longest, double* rays) {
        constexpr int STEPS = 60;                                           // a safeguard: Newton needs 4 to 8
        constexpr double EXACT = 1e-12, ROUNDING = 1e-15, AT_REST = 1e-13;  // errors that suffice; least error; step
        const int filled = (n + LANES - 1) / LANES * LANES;
        double error[CHUNK];
        bool moving[CHUNK];
        std::fill_n(moving, n, true);
        for (int i = 0; i < filled; ++i) {
            const double* ray = rays + 3 * std::min(i, n - 1);
            chunk_.x[i] = ray[0], chunk_.y[i] = ray[1], chunk_.z[i] = ray[2];
        }
        for (int step = 0, left = n; step < STEPS && left > 0; ++step) {
            lens.project(filled, chunk_, seen_);
            for (int i = 0; i < n; ++i) {
                if (!moving[i]) continue;
                const double *to = offsets + 2 * i, *ray = rays + 3 * i;
                const double x = seen_.x[i] - to[0], y = seen_.y[i] - to[1];
                error[i] = std::max(std::abs(x), std::abs(y)) / (lens.phi + std::max(std::abs(to[0]), std::abs(to[1])));
                // Two directions across the ray (Duff and others, JCGT 6, 2017), and the derivatives along them.
                const double sign = std::copysign(1.0, ray[2]), a = -1.0 / (sign + ray[2]), b = ray[0] * ray[1] * a;
                const double e[3] = {1.0 + sign * ray[0] * ray[0] * a, sign * b, -sign * ray[0]};
                const double f[3] = {b, sign + ray[1] * ray[1] * a, -ray[1]};
                const double xx = seen_.xx[i] * e[0] + seen_.xy[i] * e[1] + seen_.xz[i] * e[2];
                const double xy = seen_.xx[i] * f[0] + seen_.xy[i] * f[1] + seen_.xz[i] * f[2];
                const double yx = seen_.yx[i] * e[0] + seen_.yy[i] * e[1] + seen_.yz[i] * e[2];
                const double yy = seen_.yx[i] * f[0] + seen_.yy[i] * f[1] + seen_.yz[i] * f[2];
                const double area = xx * yy - xy * yx, p = (yy * x - xy * y) / area, q = (xx * y - yx * x) / area;
                // Where the map ends it hardly grows, and a full step would end in another branch, past the solution.
                const double length = std::hypot(p, q), part = std::min(1.0, longest / std::max(length, TINY));
                chunk_.x[i] -= part * (p * e[0] + q * f[0]);
                chunk_.y[i] -= part * (p * e[1] + q * f[1]);
                chunk_.z[i] -= part * (p * e[2] + q * f[2]);
                moving[i] = error[i] > ROUNDING && (length > AT_REST || error[i] > EXACT);
                left -= !moving[i];
            }
        }
        for (int i = 0; i < n; ++i) {
            const bool found = error[i] <= EXACT;
            double* ray = rays + 3 * i;
            ray[0] = found ? chunk_.x[i] : NAN, ray[1] = found ? chunk_.y[i] : NAN, ray[2] = found ? chunk_.z[i] : NAN;
        }
    }

  private:
    Rays chunk_;
    Image seen_;
};

}  // namespace ceres_cal
