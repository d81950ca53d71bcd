// Agreement of strokes of paint with a camera over a floor: see detect/photographs/upright.py and matching.py. Single
// precision suffices for a share, and fills a register with twice as many numbers.
#pragma once

#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include "chunk.hpp"

namespace ceres_cal {

// exp(-x) for x >= 0, accurate to 1e-7: 2 to the power of a whole number, times a polynomial of the remainder.
inline float exp_of_minus(float x) {
    const float power = -1.442695041f * x;
    const int32_t whole = static_cast<int32_t>(power);
    const float f = power - static_cast<float>(whole);                 // from -1 to 0
    const int32_t bits = (std::max<int32_t>(whole, -64) + 127) << 23;  // smaller powers count as this one
    float scale;
    std::memcpy(&scale, &bits, sizeof scale);
    constexpr float A = 0.693143721f, B = 0.240180142f, C = 0.055297357f, D = 0.00920579677f, E = 0.000944903118f;
    return scale * (1.0f + f * (A + f * (B + f * (C + f * (D + f * E)))));
}

// The share of strokes that run along the axes x or y of a floor; 0 if no more than `least` run along one of them.
// planes: x, y and z of the normals of the strokes' planes, over the sine of their tolerance; weights: of sum 1.
inline float share_along(int count, const float* planes, const float* weights, const float* x, const float* y,
                         float least) {
    const float *px = planes, *py = px + count, *pz = py + count;
    float along_x = 0.0f, along_y = 0.0f, apart = 0.0f;
    CERES_CAL_INDEPENDENT
    for (int i = 0; i < count; ++i) {
        const float off_x = x[0] * px[i] + x[1] * py[i] + x[2] * pz[i];
        const float off_y = y[0] * px[i] + y[1] * py[i] + y[2] * pz[i];
        const float by_x = exp_of_minus(off_x * off_x), by_y = exp_of_minus(off_y * off_y);
        along_x += weights[i] * by_x, along_y += weights[i] * by_y, apart += weights[i] * std::abs(by_x - by_y);
    }
    return std::min(along_x, along_y) > least ? 0.5f * (along_x + along_y + apart) : 0.0f;
}

// How near each square of `reduced` by `reduced` pixels of a picture is to strokes, from 0 to 1.
struct NearnessMap {
    const float* plane;
    int64_t height, width;
    float reduced;
};

// A lens and its picture, with ray = (p / phi, 1 + bend |p|^2), p in `unit` px from the centre.
struct BentLens {
    float bend, phi, unit, x, y, width, height;
};

// The length of lines that a camera shows, and the part of it that is near strokes.
class VisibleLines {
  public:
    // along: x, y and z of places on the lines relative to an origin. joined: whether each is on the same line as the
    // one before.
    VisibleLines(const NearnessMap& near, const BentLens& camera, int count, const float* along, const bool* joined)
        : near_(near), camera_(camera), count_(count), along_(along), joined_(joined), x_(count), y_(count) {}

    // Sets the length near strokes, the shown length (px), and the share of the places in view, for a camera at `feet`.
    void add_up(const float* feet, double* sums) {
        constexpr float TELLS_PX = 40.0f;  // largest length of a line, px, for which one place on it counts
        project(feet);
        float near = 0.0f, shown = 0.0f;
        int seen = 0;
        for (int i = 0; i < count_; ++i) {
            const float x = x_[i], y = y_[i];
            if (!(x > -0.5f && x < camera_.width - 0.5f && y > -0.5f && y < camera_.height - 0.5f)) continue;
            ++seen;
            if (!joined_[i]) continue;
            const float dx = x - x_[i - 1], dy = y - y_[i - 1], step = std::sqrt(dx * dx + dy * dy);
            if (!(step < std::numeric_limits<float>::infinity())) continue;
            const float length = std::min(step, TELLS_PX);
            shown += length, near += length * at(x, y);
        }
        sums[0] = near, sums[1] = shown, sums[2] = static_cast<double>(seen) / count_;
    }

  private:
    // Computes the pixels of the places; NaN behind the camera, or where there is none.
    void project(const float* feet) {
        const float *across = along_, *down = across + count_, *ahead = down + count_;
        float *x = x_.data(), *y = y_.data();
        CERES_CAL_INDEPENDENT
        for (int i = 0; i < count_; ++i) {
            const float a = across[i] - feet[0], b = down[i] - feet[1], c = ahead[i] - feet[2];
            const float scale = c > 0.0f ? camera_.phi / c : std::numeric_limits<float>::quiet_NaN();
            // p = ideal (1 + bend p^2): the root that is near the ideal point for a small bend.
            const float root = std::sqrt(1.0f - 4.0f * camera_.bend * (a * a + b * b) * scale * scale);
            const float times = camera_.unit * (2.0f * scale / (1.0f + root));
            x[i] = camera_.x + a * times, y[i] = camera_.y + b * times;
        }
    }

    float at(float x, float y) const {
        const int64_t column = std::lrint((x + 0.5f) / near_.reduced - 0.5f);
        const int64_t row = std::lrint((y + 0.5f) / near_.reduced - 0.5f);
        const bool inside = column >= 0 && column < near_.width && row >= 0 && row < near_.height;
        return inside ? near_.plane[row * near_.width + column] : 0.0f;
    }

    const NearnessMap near_;
    const BentLens camera_;
    const int count_;
    const float* along_;
    const bool* joined_;
    std::vector<float> x_, y_;
};

}  // namespace ceres_cal
