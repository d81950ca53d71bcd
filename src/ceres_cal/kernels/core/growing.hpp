// Where a polynomial along the radius stops growing.
#pragma once

namespace ceres_cal {

// d/dx of x (d_0 + d_1 x + d_2 x^2 ...).
inline double radial_slope(const double* dense, int count, double x) {
    double total = 0.0;
    for (int k = count - 1; k >= 0; --k) total = total * x + (k + 1) * dense[k];
    return total;
}

// Where x (d_0 + d_1 x + d_2 x^2 ...) first stops growing, or `far`, the end of what can be observed.
inline double growing_until(const double* dense, int count, double far) {
    constexpr int STEPS = 96, HALVINGS = 50;
    const double step = far / STEPS;
    double low = 0.0, high = far;
    for (int i = 1; i <= STEPS; ++i) {
        if (radial_slope(dense, count, i * step) <= 0.0) {
            low = (i - 1) * step, high = i * step;
            break;
        }
        low = i * step;
    }
    if (high < far || radial_slope(dense, count, far) <= 0.0) {
        for (int i = 0; i < HALVINGS; ++i) {
            const double middle = 0.5 * (low + high);
            (radial_slope(dense, count, middle) > 0.0 ? low : high) = middle;
        }
    }
    return low;
}

}  // namespace ceres_cal
