// Radial alignment of many sights of points: what each tells by itself, and what all say of the profile together.
//
// Points of one sight: x and y (n) of the plane, p (n, 2) offsets, of unit size each.
#pragma once

#include "planes.hpp"

namespace ceres_cal {

struct Aligned {
    int64_t n;
    const double *x, *y, *p, *weights;
};

// h (6): h1 and h2 of p_x (h2 . X) - p_y (h1 . X) = 0, scaled so that |(h1 . X, h2 . X)| is |p| on average.
inline void align(const Aligned& seen, double* h) {
    double normal[36] = {}, agree = 0.0, size = 0.0;
    for (int64_t i = 0; i < seen.n; ++i) {
        const double a = seen.p[2 * i], b = seen.p[2 * i + 1], x = seen.x[i], y = seen.y[i];
        const double row[6] = {-b * x, -b * y, -b, a * x, a * y, a};
        add_product(6, seen.weights[i], row, normal);
    }
    for (int k = 0; k < 6; ++k) h[k] = 1.0 + 0.1 * k;
    least_direction<6>(normal, h);
    for (int64_t i = 0; i < seen.n; ++i) {
        const double a = seen.p[2 * i], b = seen.p[2 * i + 1];
        const double u = h[0] * seen.x[i] + h[1] * seen.y[i] + h[2], v = h[3] * seen.x[i] + h[4] * seen.y[i] + h[5];
        agree += seen.weights[i] * (u * a + v * b), size += seen.weights[i] * (a * a + b * b);
    }
    for (int k = 0; k < 6; ++k) h[k] *= size / (std::abs(agree) > 1e-12 ? agree : 1e-12);
}

// Of r (h3 . X) - q sum c_k r^2k = q: share (3, terms + 1) is how h3 follows (c, 1); the rest is added up.
inline void add_depths(const Aligned& seen, const double* h, int columns, double* share, double* reduced) {
    const int size = 3 + columns;
    std::vector<double> products(static_cast<size_t>(size) * size), row(static_cast<size_t>(size));
    for (int64_t i = 0; i < seen.n; ++i) {
        const double a = seen.p[2 * i], b = seen.p[2 * i + 1], r = std::sqrt(a * a + b * b);
        const double u = h[0] * seen.x[i] + h[1] * seen.y[i] + h[2], v = h[3] * seen.x[i] + h[4] * seen.y[i] + h[5];
        const double q = (u * a + v * b) / std::max(r, 1e-9);
        row[0] = r * seen.x[i], row[1] = r * seen.y[i], row[2] = r, row[size - 1] = q;
        double power = -q;
        for (int k = 3; k < size - 1; ++k) power *= r * r, row[k] = power;
        add_product(size, seen.weights[i], row.data(), products.data());
    }
    const double trace = products[0] + products[size + 1] + products[2 * (size + 1)];
    for (int k = 0; k < 3; ++k) products[(size + 1) * k] += 1e-12 * trace;
    double upper[9], own[3];
    cholesky(3, products.data(), size, upper);
    for (int column = 0; column < columns; ++column) {
        for (int k = 0; k < 3; ++k) own[k] = products[size * (3 + column) + k];
        substitute(3, upper, own);
        for (int k = 0; k < 3; ++k) share[columns * k + column] = own[k];
    }
    for (int k = 0; k < columns; ++k)
        for (int j = 0; j < columns; ++j) {
            double value = products[size * (3 + std::max(k, j)) + 3 + std::min(k, j)];
            for (int i = 0; i < 3; ++i) value -= products[size * (3 + k) + i] * share[columns * i + j];
            reduced[columns * k + j] += value;
        }
}

// Distance of each point from where h12 (6) and h3 (3) send it under the profile c_k.
inline void alignment_errors(const Aligned& seen, const double* h, const double* d, const double* profile, int terms,
                             double* errors) {
    for (int64_t i = 0; i < seen.n; ++i) {
        const double a = seen.p[2 * i], b = seen.p[2 * i + 1], x = seen.x[i], y = seen.y[i],
                     r = std::sqrt(a * a + b * b);
        const double u = h[0] * x + h[1] * y + h[2], v = h[3] * x + h[4] * y + h[5];
        const double depth = d[0] * x + d[1] * y + d[2];
        double w = 0.0;
        for (int k = terms - 1; k >= 0; --k) w = (w + profile[k]) * r * r;
        const double q = (u * a + v * b) / std::max(r, 1e-9);
        const double across = (a * v - b * u) / std::max(std::sqrt(u * u + v * v), 1e-9) * r;
        const double along = r - q * (1.0 + w) / (std::abs(depth) > 1e-9 ? depth : 1e-9);
        errors[i] = std::sqrt(across * across + along * along);
    }
}

}  // namespace ceres_cal
