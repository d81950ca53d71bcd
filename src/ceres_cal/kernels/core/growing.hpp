// Where a polynomial along the radius stops growing.
#pragma once

#include <algorithm>

namespace ceres_cal {

// d/dx of x (d_0 + d_1 x + d_2 x^2 ...).
inline double radial_slope(const double* dense, int count, double x) {
    double total = 0.0;
    for (int k = count - 1; k >= 0; --k) total = total * x + (k + 1) * dense[k];
    return total;
}

// Where x (d_0 + d_1 x + d_2 x^2 ...) first stops growing, or `farthest`, the end of what can be observed. It is looked
// for in equal steps up to `far`, and in growing ones beyond.
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
