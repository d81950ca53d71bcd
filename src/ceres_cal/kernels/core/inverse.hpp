// The inverse of a map along a radius that grows: see `scene/lens/planar.py`.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

namespace ceres_cal {

// Polynomials side by side, each over the next stretch of a width and by its place there from 0 on, the last one
// without an end; over another polynomial, where there is one.
class Growing {
  public:
    Growing(int pieces, int terms, const double* above, double width, int terms_below, const double* below,
            double limit)
        : pieces_(pieces),
          terms_(terms),
          terms_below_(terms_below),
          above_(above),
          below_(below),
          width_(width),
          limit_(limit) {}

    // x up to the limit where the map is `target`, by Newton safeguarded with bisection; NaN where none is.
    double inverse(double target) const {
        constexpr double NONE = std::numeric_limits<double>::quiet_NaN(), FAR = std::numeric_limits<double>::infinity();
        if (!(target >= 0.0 && target < FAR)) return NONE;
        double low = 0.0, high = limit_ < FAR ? limit_ : target, last = FAR;
        for (int i = 0; i < STEPS && !(limit_ < FAR) && at(high).value < target; ++i) high *= 2.0;
        if (!(target <= at(high).value)) return NONE;
        double x = std::min(target, high);
        for (int i = 0; i < STEPS; ++i) {
            const Value there = at(x);
            const double error = there.value - target;
            if (error < 0.0) low = x;
            if (error > 0.0) high = x;
            double move = -error / there.slope;
            // A step that does not halve the last one may run in a circle.
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
        const double place = x / width_;
        const int piece = place < pieces_ - 1 ? static_cast<int>(place) : pieces_ - 1;
        Value found = polynomial(terms_, above_ + terms_ * piece, place - piece);
        found.slope /= width_;
        if (terms_below_ == 0) return found;
        const Value below = polynomial(terms_below_, below_, x);
        found.value /= below.value;
        found.slope = (found.slope - found.value * below.slope) / below.value;
        return found;
    }

    int pieces_, terms_, terms_below_;
    const double *above_, *below_;
    double width_, limit_;
};

}  // namespace ceres_cal
