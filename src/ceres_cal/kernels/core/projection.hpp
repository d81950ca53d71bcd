// A chunk of observations in front of the camera: its images, the feet on curves, and the derivatives.
//
// The pose is (3, 4) [R t]; derivatives by it are left perturbations in the camera frame, (dw x R X) + dt.
#pragma once

#include <algorithm>
#include <cmath>
#include <memory>

#include "lens.hpp"
#include "observations.hpp"

namespace ceres_cal {

class Projection {
  public:
    explicit Projection(Lens& lens)
        : lens(lens),
          pose_row(lens.count),
          last_row(lens.count + 6),
          buffer_(new Lane[2 * (static_cast<size_t>(last_row) + 1)]),
          shown_(new bool[last_row + 1]) {}

    Lens& lens;
    const int pose_row, last_row;  // after the rows of the intrinsics come the pose's six, then one for the residual

    Rows rows;
    Image image;
    // For curves: tangents dC/ds in the frame of the target, and the image normal.
    Lane tangent_x, tangent_y, tangent_z, normal_x, normal_y;

    // Computes the images of n points; returns false if any of them cannot be projected.
    bool show(int64_t start, int n, const double* pose, const Points& points) {
        fill(start, n, points.pixels);
        for (int i = 0; i < rows.n; ++i) {
            const double* place = points.places + 3 * (start + std::min(i, n - 1));
            x_[i] = place[0], y_[i] = place[1], z_[i] = place[2];
        }
        to_camera(pose);
        return lens.project(rows.n, rays_, image);
    }

    // Finds the feet of the perpendiculars from n pixels, tau . (project(C(s)) - p) = 0 (design, section 5), and stores
    // them in curves.feet.
    //
    // Gauss-Newton steps have their slope corrected by the secant, so that the curvature of the curve is included
    // without second derivatives. Returns false, and moves nothing, if any curve cannot be projected.
    bool show(int64_t start, int n, const double* pose, const Curves& curves) {
        fill(start, n, curves.pixels);
        load_tracks(start, n, curves);
        for (int step = 0; step < FOOT_STEPS; ++step) {
            place_on_tracks();
            to_camera(pose);
            if (!lens.project(rows.n, rays_, image)) return false;
            if (find_steps(pose, step > 0) < FOOT_TOLERANCE_PX) break;
            each(rows.n, [&](int i) { s_[i] += step_[i]; });
        }
        std::copy_n(s_.value, n, curves.feet + start);
        each(rows.n, [&](int i) {
            const double length = std::sqrt(length2_[i]);
            normal_x[i] = -tau_y_[i] / length, normal_y[i] = tau_x_[i] / length;
        });
        return true;
    }

    // The image of the point, or of the foot, minus the pixel, px.
    double off_x(int i) const { return lens.cx + image.x[i] - pixel_x_[i]; }
    double off_y(int i) const { return lens.cy + lens.aspect * image.y[i] - pixel_y_[i]; }

    // The signed distance along the normal. By the envelope theorem its derivative is that of the projected foot, with
    // s held, along the normal.
    double distance(int i) const { return normal_x[i] * off_x(i) + normal_y[i] * off_y(i); }

    // Fills the rows: derivatives of the chunk's pixels by the intrinsics (unless only the pose is free) and by the
    // pose.
    void differentiate(bool alone) {
        if (!alone) lens.fill(image, rows);
        const int n = rows.n;
        double* own[6];
        for (int k = 0; k < 6; ++k) own[k] = rows.x(pose_row + k);
        const auto component = [&](double factor, const Lane& by_x, const Lane& by_y, const Lane& by_z, int to) {
            each(n, [&](int i) {
                const double dx = factor * by_x[i], dy = factor * by_y[i], dz = factor * by_z[i];
                const double x = turned_x_[i], y = turned_y_[i], z = turned_z_[i];
                own[0][to + i] = dz * y - dy * z, own[1][to + i] = dx * z - dz * x, own[2][to + i] = dy * x - dx * y;
                own[3][to + i] = dx, own[4][to + i] = dy, own[5][to + i] = dz;
            });
        };
        component(1.0, image.xx, image.xy, image.xz, 0);
        component(lens.aspect, image.yx, image.yy, image.yz, n);
    }

    // Motions of the foot of observation k, the chunk's i: rows (x, y, z) for each structure number of its track. For a
    // segment to the left; for an arc with the centre, and outwards.
    void directions(const Curves& curves, int64_t k, int i, double (&rows)[BUILT][3]) const {
        const int64_t track = curves.track[k];
        const bool arc = curves.is_arc[track];
        // The tangent's right side is outside; turned by a quarter it is the direction of the radius.
        const double x = arc ? -tangent_x[i] : curves.tracks[9 * track + 3];
        const double y = arc ? -tangent_y[i] : curves.tracks[9 * track + 4];
        const double length = std::sqrt(x * x + y * y) + 1e-300;
        double* left = rows[arc ? 2 : 0];
        if (arc) rows[0][0] = rows[1][1] = 1.0;
        left[0] = -y / length, left[1] = x / length;
    }

    // Motions of a point: along x and y, along z in proportion to each part of its board's warp, and again along x and
    // y in proportion to the board's stretches.
    void directions(const Points& points, int64_t k, int, double (&rows)[BUILT][3]) const {
        rows[0][0] = rows[1][1] = 1.0;
        const double* bends = points.bends + (BUILT - 2) * k - 2;
        for (int a = 2; a < BUILT - 2; ++a) rows[a][2] = bends[a];
        for (int axis = 0; axis < 2; ++axis) rows[BUILT - 2 + axis][axis] = bends[BUILT - 2 + axis];
    }

  private:
    static constexpr int FOOT_STEPS = 30;
    static constexpr double FOOT_TOLERANCE_PX = 1e-9;

    void fill(int64_t start, int n, const double* pixels) {
        rows = {buffer_[0].value, shown_.get(), (n + LANES - 1) / LANES * LANES};
        for (int i = 0; i < rows.n; ++i) {
            const double* pixel = pixels + 2 * (start + std::min(i, n - 1));
            pixel_x_[i] = pixel[0], pixel_y_[i] = pixel[1];
        }
    }

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

    // Computes the next step of each foot; returns the longest, px.
    double find_steps(const double* pose, bool again) {
        const double aspect = lens.aspect;
        double worst = 0.0;
        each(rows.n, [&](int i) {
            const double tx = tangent_x[i], ty = tangent_y[i], tz = tangent_z[i];
            const double x = pose[0] * tx + pose[1] * ty + pose[2] * tz, y = pose[4] * tx + pose[5] * ty + pose[6] * tz,
                         z = pose[8] * tx + pose[9] * ty + pose[10] * tz;
            const double to_x = image.xx[i] * x + image.xy[i] * y + image.xz[i] * z;
            const double to_y = aspect * (image.yx[i] * x + image.yy[i] * y + image.yz[i] * z);
            const double along = to_x * off_x(i) + to_y * off_y(i), size = to_x * to_x + to_y * to_y;
            const double went = s_[i] - s_before_[i], secant = (along - along_before_[i]) / went;
            const double bounded = std::max(0.25 * size, std::min(secant, 4.0 * size));
            const double slope = again && went != 0.0 ? bounded : size;
            const double step = std::max(-0.5, std::min(-along / slope, 0.5));
            tau_x_[i] = to_x, tau_y_[i] = to_y, length2_[i] = size;
            s_before_[i] = s_[i], along_before_[i] = along, step_[i] = step;
            worst = std::max(worst, std::abs(step) * std::sqrt(size));
        });
        return worst;
    }

    std::unique_ptr<Lane[]> buffer_;  // Lane keeps its alignment
    std::unique_ptr<bool[]> shown_;
    Rays rays_;
    Lane x_, y_, z_, turned_x_, turned_y_, turned_z_;
    Lane track_[9], pixel_x_, pixel_y_, s_, f_, g_, df_, dg_, s_before_, along_before_, step_;
    Lane tau_x_, tau_y_, length2_;  // the tangent in the image, px
    bool is_arc_[CHUNK], bends_ = false;
};

}  // namespace ceres_cal
