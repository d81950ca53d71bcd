// Small dense matrices, row-major.
#pragma once

#include <algorithm>
#include <cmath>

#include "chunk.hpp"

namespace ceres_cal {

constexpr int MANY = 64;        // numbers above which rounding adds up in what observations leave undetermined
constexpr double LIFT = 1e-12;  // share of the diagonal that is then added against it; it changes no slope

// Computes U with U^T U = A from A's lower triangle. Where less than a share `least` of the diagonal is left, the row
// of U is zero. Row i of A begins at i * stride.
inline void cholesky(int size, const double* normal, int stride, double* upper, double least = 1e-15) {
    const double whole = 1.0 + (size > MANY ? LIFT : 0.0);
    std::fill_n(upper, static_cast<size_t>(size) * size, 0.0);
    for (int k = 0; k < size; ++k) {
        double* own = upper + static_cast<size_t>(size) * k;
        const double diagonal = normal[static_cast<size_t>(stride) * k + k];
        own[k] = whole * diagonal;
        for (int i = k + 1; i < size; ++i) own[i] = normal[static_cast<size_t>(stride) * i + k];
        for (int j = 0; j < k; ++j) {
            const double *above = upper + static_cast<size_t>(size) * j, factor = above[k];
            if (factor == 0.0) continue;
            for (int i = k; i < size; ++i) own[i] -= factor * above[i];
        }
        if (!(own[k] > least * diagonal)) {
            std::fill(own + k, own + size, 0.0);
            continue;
        }
        const double root = std::sqrt(own[k]);
        own[k] = root;
        for (int i = k + 1; i < size; ++i) own[i] /= root;
    }
}

// x <- (U^T U)^-1 x for x (size, columns), by forward and back substitution; where a row of U is zero, so is that of x.
inline void substitute(int size, const double* upper, double* x, int columns = 1) {
    const auto finish = [&](int k, int first, int last, int apart, const double* factors) {
        double *own = x + columns * k, diagonal = upper[size * k + k], scale = diagonal > 0.0 ? 1.0 / diagonal : 0.0;
        for (int j = first; j < last; ++j) {
            const double factor = factors[apart * j], *other = x + columns * j;
            CERES_CAL_INDEPENDENT
            for (int i = 0; i < columns; ++i) own[i] -= factor * other[i];
        }
        for (int i = 0; i < columns; ++i) own[i] *= scale;
    };
    for (int k = 0; k < size; ++k) finish(k, 0, k, size, upper + k);
    for (int k = size - 1; k >= 0; --k) finish(k, k + 1, size, 1, upper + size * k);
}

// Replaces a symmetric matrix (size, size) by its eigenvalues on the diagonal; the eigenvectors are the columns of
// `vectors`.
inline void eigen(int size, double* matrix, double* vectors) {
    constexpr int MOST = 50;  // rounds of Jacobi rotations: about eight are enough
    constexpr double ROUNDING = 1e-32;
    const auto rotate = [&](double* a, int p, int q, int next, double sine, double cosine) {
        for (int k = 0; k < size; ++k) {
            double &one = a[p + next * k], &other = a[q + next * k], before = one;
            one = cosine * before - sine * other, other = sine * before + cosine * other;
        }
    };
    std::fill_n(vectors, size * size, 0.0);
    for (int k = 0; k < size; ++k) vectors[(size + 1) * k] = 1.0;
    for (int round = 0; round < MOST; ++round) {
        double off = 0.0, whole = 0.0;
        for (int k = 0; k < size * size; ++k) (k % (size + 1) == 0 ? whole : off) += matrix[k] * matrix[k];
        if (!(off > ROUNDING * whole)) break;
        for (int p = 0; p < size; ++p)
            for (int q = p + 1; q < size; ++q) {
                const double between = matrix[size * p + q];
                if (between == 0.0) continue;
                const double half = 0.5 * (matrix[(size + 1) * q] - matrix[(size + 1) * p]) / between;
                const double tangent = std::copysign(1.0, half) / (std::abs(half) + std::sqrt(half * half + 1.0));
                const double cosine = 1.0 / std::sqrt(tangent * tangent + 1.0), sine = tangent * cosine;
                rotate(matrix, p, q, size, sine, cosine);
                rotate(matrix, size * p, size * q, 1, sine, cosine);
                rotate(vectors, p, q, size, sine, cosine);
            }
    }
}

// out (rows, columns) = a (rows, inner) b (inner, columns); `..._apart`: distance of consecutive rows in memory.
inline void multiply(int rows, int inner, int columns, const double* a, int a_apart, const double* b, int b_apart,
                     double* out, int out_apart) {
    for (int j = 0; j < rows; ++j)
        for (int k = 0; k < columns; ++k) {
            double sum = 0.0;
            for (int i = 0; i < inner; ++i) sum += a[a_apart * j + i] * b[b_apart * i + k];
            out[out_apart * j + k] = sum;
        }
}

// The squared angle of a rotation vector, sin a / a, (1 - cos a) / a^2, (a - sin a) / a^3; accurate also for tiny
// angles.
struct SineSeries {
    double angle2, sine, versine, rest;
    explicit SineSeries(const double* w) : angle2(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) {
        const double angle = std::sqrt(angle2);
        if (angle < 1e-4) {
            sine = 1.0 - angle2 / 6.0, versine = 0.5 - angle2 / 24.0, rest = 1.0 / 6.0 - angle2 / 120.0;
            return;
        }
        const double half = std::sin(0.5 * angle) / angle;
        sine = std::sin(angle) / angle, versine = 2.0 * half * half;
        rest = (angle - std::sin(angle)) / (angle * angle2);
    }
};

// diagonal 1 + outer w w^T + cross [w]x, (3, 3).
inline void turn(const double* w, double diagonal, double outer, double cross, double* out) {
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) out[3 * j + k] = outer * w[j] * w[k] + (j == k ? diagonal : 0.0);
    const double x = cross * w[0], y = cross * w[1], z = cross * w[2];
    out[1] -= z, out[3] += z, out[2] += y, out[6] -= y, out[5] -= x, out[7] += x;
}

// Rodrigues' formula, (3, 3).
inline void rotation(const double* w, double* out) {
    const SineSeries series(w);
    turn(w, 1.0 - series.versine * series.angle2, series.versine, series.sine, out);
}

// J with exp(w + dw) = exp(J dw) exp(w), (3, 3).
inline void left_jacobian(const double* w, double* out) {
    const SineSeries series(w);
    turn(w, 1.0 - series.rest * series.angle2, series.rest, series.versine, out);
}

}  // namespace ceres_cal
