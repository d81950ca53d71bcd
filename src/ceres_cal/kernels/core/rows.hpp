// Every observation for itself, in px: residuals, and the Jacobian that the sums are made of.
#pragma once

#include "losses.hpp"
#include "projection.hpp"
#include "sums.hpp"

namespace ceres_cal {

// of_chunk(start, n) of all chunks from one observation to another; false where any of them is.
template <class OfChunk>
inline bool all_chunks(int64_t start, int64_t end, OfChunk of_chunk) {
    bool good = true;
    for (int n; start < end; start += n) {
        n = chunk_from(start, end);
        good &= of_chunk(start, n);
    }
    return good;
}

// project(X) - p in px of one sight, to `rows` of `residuals`; NaN where there is none.
inline void point_residuals(int64_t sight, Projection& shown, const double* pose, const Points& points,
                            const int64_t* rows, double* residuals) {
    const auto of_chunk = [&](int64_t start, int n) {
        if (!shown.show_points(start, n, pose, points)) return false;
        const Optics& optics = shown.optics;
        for (int i = 0; i < n; ++i) {
            const double* pixel = points.pixels + 2 * (start + i);
            double* own = residuals + 2 * rows[start + i];
            own[0] = optics.cx + shown.image.x[i] - pixel[0];
            own[1] = optics.cy + optics.aspect * shown.image.y[i] - pixel[1];
        }
        return true;
    };
    all_chunks(points.bounds[sight], points.bounds[sight + 1], [&](int64_t start, int n) {
        if (of_chunk(start, n)) return true;
        for (int64_t k = start; k < start + n; ++k)
            if (!of_chunk(k, 1)) residuals[2 * rows[k]] = residuals[2 * rows[k] + 1] = NO_ANSWER;
        return false;
    });
}

// Signed distance from each pixel to its curve in px, and s moved to the foot; NaN where there is none.
inline void curve_residuals(int64_t sight, Projection& shown, const double* pose, const Curves& curves,
                            double* residuals) {
    const auto of_chunk = [&](int64_t start, int n) {
        if (!shown.show_feet(start, n, pose, curves)) return false;
        for (int i = 0; i < n; ++i) {
            const double across = shown.tau_x[i] * shown.off_y[i] - shown.tau_y[i] * shown.off_x[i];
            residuals[start + i] = across / std::sqrt(shown.length2[i]);
        }
        return true;
    };
    all_chunks(curves.bounds[sight], curves.bounds[sight + 1], [&](int64_t start, int n) {
        if (of_chunk(start, n)) return true;
        for (int64_t k = start; k < start + n; ++k)
            if (!of_chunk(k, 1)) residuals[k] = NO_ANSWER;
        return false;
    });
}

// A row's last BUILT places, the target moved along each direction; those before are the pose's translation.
inline void add_built(const double* pose, const double* directions, int size, double* row) {
    double* own = row + size - BUILT;
    for (int a = 0; a < BUILT; ++a) {
        own[a] = 0.0;
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) own[a] += own[j - 3] * pose[4 * j + k] * directions[3 * a + k];
    }
}

// d project(X) / d [intrinsics | 6 pose | x, y, the warp's numbers] of one sight into `rows` (N, 2, intrinsics + 6 +
// BUILT); NaN where it has points that cannot be projected.
inline void point_rows(int64_t sight, Projection& shown, const double* pose, const Points& points, double* rows) {
    const int numbers = shown.last_row, size = numbers + BUILT;
    all_chunks(points.bounds[sight], points.bounds[sight + 1], [&](int64_t start, int n) {
        double* first = rows + 2 * size * start;
        if (!shown.show_points(start, n, pose, points)) {
            std::fill_n(first, 2 * static_cast<size_t>(size) * n, NO_ANSWER);
            return false;
        }
        shown.differentiate(false);
        for (int k = 0; k < shown.pose_row; ++k) shown.rows.open(k);
        double directions[3 * BUILT];
        for (int i = 0; i < n; ++i) {
            point_directions(points.bends + (BUILT - 2) * (start + i), directions);
            for (int c = 0; c < 2; ++c) {
                double* row = first + size * (2 * i + c);
                for (int k = 0; k < numbers; ++k) row[k] = shown.rows.x(k)[c * shown.rows.n + i];
                add_built(pose, directions, size, row);
            }
        }
        return true;
    });
}

// The same of the signed distance to the curve, into `rows` (M, intrinsics + 6 + BUILT), by the envelope theorem; the
// last columns are of a segment's offset to the left, or of an arc's x, y and radius, and 0. False where a curve cannot
// be projected. normals: (M, 2), filled with the image normal at the foot.
inline bool curve_rows(int64_t sight, Projection& shown, const double* pose, const Curves& curves, double* rows,
                       double* normals) {
    const int numbers = shown.last_row, size = numbers + BUILT;
    return all_chunks(curves.bounds[sight], curves.bounds[sight + 1], [&](int64_t start, int n) {
        if (!shown.show_feet(start, n, pose, curves)) return false;
        shown.differentiate(false);
        for (int k = 0; k < shown.pose_row; ++k) shown.rows.open(k);
        for (int i = 0; i < n; ++i) {
            const double length = std::sqrt(shown.length2[i]), nx = -shown.tau_y[i] / length,
                         ny = shown.tau_x[i] / length;
            double *normal = normals + 2 * (start + i), *row = rows + size * (start + i);
            normal[0] = nx, normal[1] = ny;
            for (int k = 0; k < numbers; ++k) row[k] = nx * shown.rows.x(k)[i] + ny * shown.rows.y(k)[i];
            double directions[3 * BUILT] = {};
            curve_directions(curves, curves.track[start + i], shown.tangent_x[i], shown.tangent_y[i], directions);
            add_built(pose, directions, size, row);
        }
        return true;
    });
}

}  // namespace ceres_cal
