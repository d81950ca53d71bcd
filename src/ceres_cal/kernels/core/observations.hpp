// What the kernels are handed, as plain pointers: see arguments.py, which says what each is.
#pragma once

#include "chunk.hpp"

namespace ceres_cal {

constexpr int BUILT = 7;     // structure numbers at most that move a point
constexpr int ON_TRACK = 3;  // and a track

// RESIDUALS of each observation, and by how many structure numbers at most it is MOVED; moved(k): where k's slots are.
struct Points {
    static constexpr int RESIDUALS = 2, MOVED = BUILT;
    const int64_t* bounds;
    const double *places, *pixels, *weights;
    const int32_t* slots;  // null without structure
    const double* bends;
    int64_t moved(int64_t k) const { return k; }
};

struct Curves {
    static constexpr int RESIDUALS = 1, MOVED = ON_TRACK;
    const int64_t* bounds;
    const double* tracks;
    const bool* is_arc;
    const int32_t* track;
    const double *pixels, *weights;
    double* feet;
    const int32_t* slots;
    int64_t moved(int64_t k) const { return track[k]; }
};

// of_chunk(start, n) of all chunks of a sight, each about as long; false where any of them is.
template <class Columns, class OfChunk>
inline bool all_chunks(const Columns& seen, int64_t sight, OfChunk of_chunk) {
    bool good = true;
    for (int64_t start = seen.bounds[sight], end = seen.bounds[sight + 1], n; start < end; start += n) {
        const int64_t left = end - start, chunks = (left + CHUNK - 1) / CHUNK;
        n = (left + chunks - 1) / chunks;
        good &= of_chunk(start, static_cast<int>(n));
    }
    return good;
}

enum class LossCode : uint8_t { trivial, huber, soft_l1, cauchy, tukey };

struct Loss {
    LossCode code;
    double scale;
};

// What sights show, and the loss that it is judged by.
struct Observed {
    Points points;
    Curves curves;
    Loss loss;
};

// Which numbers take part: A is [free intrinsics | structure | 6 pose | residual].
struct Unknowns {
    const int64_t* free;
    int count, structure;
    int shared() const { return count + structure; }
    int size() const { return shared() + 7; }
};

}  // namespace ceres_cal
