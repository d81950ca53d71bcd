// A chunk of observations before the camera: where they are shown, where the feet on curves are, and the derivatives.
//
// The pose is (3, 4) [R t]; its derivatives are left perturbations in the camera frame, (dw x R X) + dt.
#pragma once

#include <algorithm>
#include <cmath>
#include <memory>

#include "observations.hpp"
#include "optics.hpp"

namespace ceres_cal {

class Projection {
  public:
    explicit Projection(const Optics& optics)
        : optics(optics),
          pose_row(optics.count),
          last_row(optics.count + 6),
          buffer_(new double[2 * static_cast<size_t>(CHUNK) * (last_row + 1)]),
          shown_(new bool[last_row + 1]) {}

    const Optics& optics;
    const int pose_row, last_row;  // after the intrinsics' rows the pose's six, then one for the residual

    Rows rows;
    Image image;
    // Of curves: tangents dC/ds in the frame of the target; tau, the tangent in the image, px; its squared length; the
    // foot less the pixel, px.
    Lane tangent_x, tangent_y, tangent_z, tau_x, tau_y, length2, off_x, off_y;

    // The images of n points; false where any of them cannot be projected.
    bool show_points(int64_t start, int n, const double* pose, const Points& points) {
        fill(n);
        for (int i = 0; i < rows.n; ++i) {
            const double* place = points.places + 3 * (start + std::min(i, n - 1));
            x_[i] = place[0], y_[i] = place[1], z_[i] = place[2];
        }
        to_camera(pose);
        return optics.distort(rows.n, rays_, image);
    }

    // The feet of the perpendiculars from n pixels, tau . (project(C(s)) - p) = 0 (design, section 5), to curves.feet.
    //
    // Gauss-Newton steps whose slope is corrected by the secant, so that the curve's own bend is seen without second
    // derivatives. False, and nothing moved, where any curve cannot be projected.
    bool show_feet(int64_t start, int n, const double* pose, const Curves& curves) {
        fill(n);
        load_tracks(start, n, curves);
        for (int step = 0; step < FOOT_STEPS; ++step) {
            place_on_tracks();
            to_camera(pose);
            if (!optics.distort(rows.n, rays_, image)) return false;
            if (find_steps(pose, step > 0) < FOOT_TOLERANCE_PX) break;
            each(rows.n, [&](int i) { s_[i] += step_[i]; });
        }
        std::copy_n(s_.value, n, curves.feet + start);
        return true;
    }

    // The rows: derivatives of the chunk's pixels by the intrinsics (but not where the pose alone is free) and the
    // pose.
    void differentiate(bool alone) {
        if (!alone) optics.differentiate(image, rows);
        const double aspect = optics.aspect;
        const int n = rows.n;
        double* own[6];
        for (int k = 0; k < 6; ++k) own[k] = rows.x(pose_row + k);
        each(n, [&](int i) {
            const double dx = image.xx[i], dy = image.xy[i], dz = image.xz[i], x = turned_x_[i], y = turned_y_[i],
                         z = turned_z_[i];
            own[0][i] = dz * y - dy * z, own[1][i] = dx * z - dz * x, own[2][i] = dy * x - dx * y;
            own[3][i] = dx, own[4][i] = dy, own[5][i] = dz;
        });
        each(n, [&](int i) {
            const double dx = aspect * image.yx[i], dy = aspect * image.yy[i], dz = aspect * image.yz[i],
                         x = turned_x_[i], y = turned_y_[i], z = turned_z_[i];
            own[0][n + i] = dz * y - dy * z, own[1][n + i] = dx * z - dz * x, own[2][n + i] = dy * x - dx * y;
            own[3][n + i] = dx, own[4][n + i] = dy, own[5][n + i] = dz;
        });
    }

  private:
    static constexpr int FOOT_STEPS = 30;
    static constexpr double FOOT_TOLERANCE_PX = 1e-9;

    void fill(int n) { rows = {buffer_.get(), shown_.get(), filled_up(n)}; }

    void to_camera(const double* pose) {
        each(rows.n, [&](int i) {
            const double x = x_[i], y = y_[i], z = z_[i];
            turned_x_[i] = pose[0] * x + pose[1] * y + pose[2] * z, rays_.x[i] = turned_x_[i] + pose[3];
            turned_y_[i] = pose[4] * x + pose[5] * y + pose[6] * z, rays_.y[i] = turned_y_[i] + pose[7];
            turned_z_[i] = pose[8] * x + pose[9] * y + pose[10] * z, rays_.z[i] = turned_z_[i] + pose[11];
        });
    }

    void load_tracks(int64_t start, int n, const Curves& curves) {
        bends_ = false;
        for (int i = 0; i < rows.n; ++i) {
            const int64_t j = start + std::min(i, n - 1), k = curves.track[j];
            for (int part = 0; part < 9; ++part) track_[part][i] = curves.tracks[9 * k + part];
            is_arc_[i] = curves.is_arc[k];
            bends_ |= is_arc_[i];
            s_[i] = curves.feet[j];
            pixel_x_[i] = curves.pixels[2 * j], pixel_y_[i] = curves.pixels[2 * j + 1];
        }
    }

    // C(s) and dC/ds: c + s a on a segment, c + a cos s + b sin s on an arc.
    void place_on_tracks() {
        each(rows.n, [&](int i) { f_[i] = s_[i], g_[i] = 0.0, df_[i] = 1.0, dg_[i] = 0.0; });
        for (int i = 0; i < rows.n && bends_; ++i)
            if (is_arc_[i]) f_[i] = dg_[i] = std::cos(s_[i]), g_[i] = std::sin(s_[i]), df_[i] = -g_[i];
        each(rows.n, [&](int i) {
            x_[i] = track_[0][i] + f_[i] * track_[3][i] + g_[i] * track_[6][i];
            y_[i] = track_[1][i] + f_[i] * track_[4][i] + g_[i] * track_[7][i];
            z_[i] = track_[2][i] + f_[i] * track_[5][i] + g_[i] * track_[8][i];
            tangent_x[i] = df_[i] * track_[3][i] + dg_[i] * track_[6][i];
            tangent_y[i] = df_[i] * track_[4][i] + dg_[i] * track_[7][i];
            tangent_z[i] = df_[i] * track_[5][i] + dg_[i] * track_[8][i];
        });
    }

    // Where each foot goes next; the answer is how far the farthest goes, px.
    double find_steps(const double* pose, bool again) {
        const double aspect = optics.aspect, cx = optics.cx, cy = optics.cy;
        double worst = 0.0;
        each(rows.n, [&](int i) {
            const double tx = tangent_x[i], ty = tangent_y[i], tz = tangent_z[i];
            const double x = pose[0] * tx + pose[1] * ty + pose[2] * tz, y = pose[4] * tx + pose[5] * ty + pose[6] * tz,
                         z = pose[8] * tx + pose[9] * ty + pose[10] * tz;
            const double to_x = image.xx[i] * x + image.xy[i] * y + image.xz[i] * z;
            const double to_y = aspect * (image.yx[i] * x + image.yy[i] * y + image.yz[i] * z);
            const double dx = cx + image.x[i] - pixel_x_[i], dy = cy + aspect * image.y[i] - pixel_y_[i];
            const double along = to_x * dx + to_y * dy, size = to_x * to_x + to_y * to_y;
            const double went = s_[i] - s_before_[i], secant = (along - along_before_[i]) / went;
            const double bounded = std::max(0.25 * size, std::min(secant, 4.0 * size));
            const double slope = again && went != 0.0 ? bounded : size;
            const double step = std::max(-0.5, std::min(-along / slope, 0.5));
            tau_x[i] = to_x, tau_y[i] = to_y, off_x[i] = dx, off_y[i] = dy, length2[i] = size;
            s_before_[i] = s_[i], along_before_[i] = along, step_[i] = step;
            worst = std::max(worst, std::abs(step) * std::sqrt(size));
        });
        return worst;
    }

    std::unique_ptr<double[]> buffer_;
    std::unique_ptr<bool[]> shown_;
    Rays rays_;
    Lane x_, y_, z_, turned_x_, turned_y_, turned_z_;
    Lane track_[9], pixel_x_, pixel_y_, s_, f_, g_, df_, dg_, s_before_, along_before_, step_;
    bool is_arc_[CHUNK], bends_ = false;
};

// Where the foot on track k goes, rows (x, y, z) for each of its structure numbers: to the left of a segment; with the
// centre and outwards on an arc.
inline void curve_directions(const Curves& curves, int64_t k, double tangent_x, double tangent_y, double* directions) {
    std::fill_n(directions, 3 * ON_TRACK, 0.0);
    if (curves.is_arc[k]) {
        // The tangent's right side is outside; turned by a quarter it is the radius' own direction.
        const double length = std::sqrt(tangent_x * tangent_x + tangent_y * tangent_y);
        directions[0] = 1.0, directions[4] = 1.0;
        directions[6] = tangent_y / length, directions[7] = -tangent_x / length;
    } else {
        const double x = curves.tracks[9 * k + 3], y = curves.tracks[9 * k + 4];
        const double length = std::sqrt(x * x + y * y) + 1e-300;
        directions[0] = -y / length, directions[1] = x / length;
    }
}

// Where a point goes: along x and y, and along z as much as each part of its board's warp says.
inline void point_directions(const double* bends, double* directions) {
    std::fill_n(directions, 3 * BUILT, 0.0);
    directions[0] = 1.0, directions[4] = 1.0;
    for (int k = 2; k < BUILT; ++k) directions[3 * k + 2] = bends[k - 2];
}

}  // namespace ceres_cal
