// A chunk of observations is laid out number by number, so that plain loops over it fill the SIMD registers.
#pragma once

#include <cstdint>

#if defined(__clang__)
#define CERES_CAL_INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#elif defined(__GNUC__)
#define CERES_CAL_INDEPENDENT _Pragma("GCC ivdep")
#else
#define CERES_CAL_INDEPENDENT __pragma(loop(ivdep))
#endif

namespace ceres_cal {

constexpr int CHUNK = 128;  // observations at most: what is worked on stays in the first cache
constexpr int LANES = 4;    // a chunk is filled up to a multiple of it, by its last observation without a weight

struct alignas(64) Lane {
    double value[CHUNK];
    double& operator[](int i) { return value[i]; }
    double operator[](int i) const { return value[i]; }
};

// body(i) for i from 0 to n, a multiple of LANES; no i has to do with another one.
template <class Body>
inline void each(int n, Body body) {
    const int end = n & ~(LANES - 1);
    CERES_CAL_INDEPENDENT
    for (int i = 0; i < end; ++i) body(i);
}

// Rays in the camera's frame.
struct Rays {
    Lane x, y, z;
};

// Offsets from the principal point on square pixels, px, and their derivatives by the ray's x, y and z.
struct Image {
    Lane x, y, xx, xy, yx, yy, xz, yz;
};

// Derivatives of the chunk's pixels, a row for each number: x components, then y components.
struct Rows {
    double* base;
    bool* shown;  // of each intrinsic whether the chunk shows anything of it; rows of others are not filled
    int n;
    double* x(int row) const { return base + 2 * static_cast<int64_t>(n) * row; }
    double* y(int row) const { return x(row) + n; }
    // A row to be filled.
    double* show(int row) const { return shown[row] = true, x(row); }
    // A row to be added to, 0 at first.
    void open(int row) const {
        if (shown[row]) return;
        double* own = show(row);
        each(2 * n, [=](int i) { own[i] = 0.0; });
    }
};

}  // namespace ceres_cal
