// A chunk of observations is stored component by component, so that plain loops over it fill the SIMD registers.
#pragma once

#include <algorithm>
#include <cstdint>

#if defined(__clang__)
#define CERES_CAL_INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#elif defined(__GNUC__)
#define CERES_CAL_INDEPENDENT _Pragma("GCC ivdep")
#else
#define CERES_CAL_INDEPENDENT __pragma(loop(ivdep))
#endif

namespace ceres_cal {

constexpr int CHUNK = 128;  // most observations in a chunk: its data stay in the first-level cache
constexpr int LANES = 4;    // a chunk is padded to a multiple of this with copies of its last observation, of weight 0

struct alignas(64) Lane {
    double value[CHUNK];
    double& operator[](int i) { return value[i]; }
    double operator[](int i) const { return value[i]; }
};

// Calls body(i) for i from 0 to n, a multiple of LANES; the iterations must be independent.
template <class Body>
inline void each(int n, Body body) {
    const int end = n & ~(LANES - 1);
    CERES_CAL_INDEPENDENT
    for (int i = 0; i < end; ++i) body(i);
}

// products = P P^T over the first n columns of `count` rows, lower triangle; each row of products has count + 3
// numbers. Blocks of four rows by three reduce the reads; with larger blocks the sums would no longer fit into the
// processor's registers.
inline void find_products(double* const* own, int count, int n, double* products) {
    const int last = count - 1, stride = count + 3, end = n & ~(LANES - 1);
    for (int k = 0; k < count; k += 4) {
        const double *a = own[k], *b = own[std::min(k + 1, last)], *c = own[std::min(k + 2, last)],
                     *d = own[std::min(k + 3, last)];
        for (int j = 0; j < std::min(k + 4, count); j += 3) {
            const double *x = own[j], *y = own[std::min(j + 1, last)], *z = own[std::min(j + 2, last)];
            double ax = 0.0, ay = 0.0, az = 0.0, bx = 0.0, by = 0.0, bz = 0.0;
            double cx = 0.0, cy = 0.0, cz = 0.0, dx = 0.0, dy = 0.0, dz = 0.0;
            for (int i = 0; i < end; ++i) {
                ax += a[i] * x[i], ay += a[i] * y[i], az += a[i] * z[i];
                bx += b[i] * x[i], by += b[i] * y[i], bz += b[i] * z[i];
                cx += c[i] * x[i], cy += c[i] * y[i], cz += c[i] * z[i];
                dx += d[i] * x[i], dy += d[i] * y[i], dz += d[i] * z[i];
            }
            const double sums[4][3] = {{ax, ay, az}, {bx, by, bz}, {cx, cy, cz}, {dx, dy, dz}};
            for (int row = 0; row < 4; ++row) std::copy_n(sums[row], 3, products + stride * (k + row) + j);
        }
    }
}

// Rays in the camera's frame.
struct Rays {
    Lane x, y, z;
};

// Offsets from the principal point on square pixels, px, and their derivatives by the ray's x, y and z.
struct Image {
    Lane x, y, xx, xy, yx, yy, xz, yz;
};

// Derivatives of the chunk's pixels, one row for each number: x components, then y components.
struct Rows {
    double* base;
    bool* shown;  // for each intrinsic, whether the chunk depends on it; rows of other intrinsics are not filled
    int n;
    double* x(int row) const { return base + 2 * static_cast<int64_t>(n) * row; }
    double* y(int row) const { return x(row) + n; }
    // A row that the caller fills.
    double* show(int row) const { return shown[row] = true, x(row); }
    // A row to which the caller adds; it is set to 0 at first.
    void open(int row) const {
        if (shown[row]) return;
        double* own = show(row);
        each(2 * n, [=](int i) { own[i] = 0.0; });
    }
};

}  // namespace ceres_cal
