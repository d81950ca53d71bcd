// What a lens does for the solve: a chunk of rays at a time.
#pragma once

#include <stdexcept>

#include "chunk.hpp"

namespace ceres_cal {

// A row of numbers whose places are checked: a lens is made from it, chunks are not.
struct Numbers {
    const double* values;
    int count;
    double operator[](int place) const { return *from(place, 1); }
    const double* from(int place, int many) const {
        if (place < 0 || place + many > count) throw std::invalid_argument("a lens has fewer numbers than its kind");
        return values + place;
    }
};

// What a lens is made from: `Lens.form` of Python, the intrinsics without the skew, and half the image diagonal, px.
struct Making {
    Numbers form, intrinsics;
    double unit;
};

// Brown's decentring of a point (a, b): where it moves to, and the derivatives of that, which are symmetric.
struct Decentring {
    double p1 = 0.0, p2 = 0.0;
    double x(double a, double b) const { return 2.0 * p1 * a * b + p2 * (3.0 * a * a + b * b); }
    double y(double a, double b) const { return p1 * (a * a + 3.0 * b * b) + 2.0 * p2 * a * b; }
    double xx(double a, double b) const { return 2.0 * p1 * b + 6.0 * p2 * a; }
    double xy(double a, double b) const { return 2.0 * p1 * a + 2.0 * p2 * b; }
    double yy(double a, double b) const { return 6.0 * p1 * b + 2.0 * p2 * a; }
};

class Lens {
  public:
    Lens() = default;
    Lens(const Lens&) = delete;
    Lens& operator=(const Lens&) = delete;
    virtual ~Lens() = default;

    // Fills the first n places of the image; false where any ray has no answer.
    virtual bool distort(int n, const Rays& rays, Image& image) = 0;

    // Of the rays that were distorted last: rows 4 and on, the derivatives of the pixel's x and y (its y is aspect
    // times the offset's) by each coefficient as the solver has it; and row 0, phi's, where the offset is not
    // proportional to phi. Marks the rows that it fills.
    virtual void differentiate(const Rows& rows) = 0;
};

constexpr double TINY = 1e-150;  // its square is still a number

}  // namespace ceres_cal
