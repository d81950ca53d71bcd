// What the kernels are handed, as plain pointers: see arguments.py, which says what each is.
#pragma once

#include <cstdint>
#include <vector>

namespace ceres_cal {

constexpr int BUILT = 7;     // structure numbers at most that move a point
constexpr int ON_TRACK = 3;  // and a track

struct Points {
    const int64_t* bounds;
    const double *places, *pixels, *weights;
    const int32_t* slots;  // null without structure
    const double* bends;
};

struct Curves {
    const int64_t* bounds;
    const double* tracks;
    const bool* is_arc;
    const int32_t* track;
    const double *pixels, *weights;
    double* feet;
    const int32_t* slots;
};

enum class LossCode : int { trivial, huber, soft_l1, cauchy, tukey };

struct Loss {
    LossCode code;
    double scale;
};

// Which numbers take part: A is [free intrinsics | structure | 6 pose | residual].
struct Unknowns {
    const int64_t* free;
    int count, structure;
    int shared() const { return count + structure; }
    int size() const { return shared() + 7; }
};

}  // namespace ceres_cal
