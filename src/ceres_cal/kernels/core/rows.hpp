// Every observation for itself, in px: residuals, and the Jacobian that the sums are made of.
#pragma once

#include "sums.hpp"

namespace ceres_cal {

// The residuals of one sight, project(X) - p of points and the signed distance from pixels to their curves, to the
// places `rows` (null: in order); NaN, and false, where there is none. s is moved to the foot.
template <class Columns>
inline bool residuals_of(int64_t sight, Projection& shown, const double* pose, const Columns& seen, const int64_t* rows,
                         double* residuals) {
    constexpr int MANY = Columns::RESIDUALS;
    const auto place = [&](int64_t k) { return residuals + MANY * (rows != nullptr ? rows[k] : k); };
    const auto of_chunk = [&](int64_t start, int n) {
        if (!shown.show(start, n, pose, seen)) return false;
        for (int i = 0; i < n; ++i) {
            double* own = place(start + i);
            own[0] = MANY == 2 ? shown.off_x(i) : shown.distance(i);
            if (MANY == 2) own[1] = shown.off_y(i);
        }
        return true;
    };
    return all_chunks(seen, sight, [&](int64_t start, int n) {
        const bool good = of_chunk(start, n);
        for (int64_t k = start; !good && k < start + n; ++k)
            if (!of_chunk(k, 1)) std::fill_n(place(k), MANY, NO_ANSWER);
        return good;
    });
}

// d residual / d [intrinsics | 6 pose | what moves the observation, BUILT] of one sight into `rows`, RESIDUALS of them
// for each observation; false, and NaN, where a chunk of it cannot be projected. normals: of curves (M, 2), filled with
// the image normal at the foot.
template <class Columns>
inline bool rows_of(int64_t sight, Projection& shown, const double* pose, const Columns& seen, double* rows,
                    double* normals) {
    constexpr int MANY = Columns::RESIDUALS;
    const int numbers = shown.last_row, size = numbers + BUILT;
    return all_chunks(seen, sight, [&](int64_t start, int n) {
        double* row = rows + MANY * size * start;
        if (!shown.show(start, n, pose, seen)) {
            std::fill_n(row, static_cast<size_t>(MANY) * size * n, NO_ANSWER);
            return false;
        }
        shown.differentiate(false);
        for (int k = 0; k < shown.pose_row; ++k) shown.rows.open(k);
        for (int i = 0; i < n; ++i) {
            double nx = 0.0, ny = 0.0;
            if (MANY == 1) nx = shown.normal_x[i], ny = shown.normal_y[i];
            if (MANY == 1) normals[2 * (start + i)] = nx, normals[2 * (start + i) + 1] = ny;
            double directions[BUILT][3] = {};
            shown.directions(seen, start + i, i, directions);
            for (int c = 0; c < MANY; ++c, row += size) {
                for (int k = 0; k < numbers; ++k) {
                    const double x = shown.rows.x(k)[i], y = shown.rows.y(k)[i];
                    row[k] = MANY == 1 ? nx * x + ny * y : (c == 0 ? x : y);
                }
                for (int a = 0; a < BUILT; ++a) row[numbers + a] = along(row + numbers - 3, pose, directions[a]);
            }
        }
        return true;
    });
}

}  // namespace ceres_cal
