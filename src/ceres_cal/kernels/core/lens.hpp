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

class Lens {
  public:
    explicit Lens(const Making& from) : phi_(from.intrinsics[0]), aspect_(from.intrinsics[1]), unit_(from.unit) {}
    Lens(const Lens&) = delete;
    Lens& operator=(const Lens&) = delete;
    virtual ~Lens() = default;

    // Fills the first n places of the image; false where any ray has no answer.
    virtual bool distort(int n, const Rays& rays, Image& image) = 0;

    // Of the rays that were distorted last: rows 4 and on, the derivatives of the pixel's x and y (its y is aspect
    // times the offset's) by each coefficient as the solver has it; and row 0, phi's, where the offset is not
    // proportional to phi. Marks the rows that it fills.
    virtual void differentiate(const Rows& rows) = 0;

  protected:
    const double phi_, aspect_, unit_;
};

constexpr double TINY = 1e-150;  // its square is still a number

// d/dx of x (d_0 + d_1 x + d_2 x^2 ...).
inline double radial_slope(const double* dense, int count, double x) {
    double total = 0.0;
    for (int k = count - 1; k >= 0; --k) total = total * x + (k + 1) * dense[k];
    return total;
}

// Where x (d_0 + d_1 x + d_2 x^2 ...) first stops growing, or `far`, the end of what can be observed.
inline double growing_until(const double* dense, int count, double far) {
    constexpr int STEPS = 96, HALVINGS = 50;
    const double step = far / STEPS;
    double low = 0.0, high = far;
    for (int i = 1; i <= STEPS; ++i) {
        if (radial_slope(dense, count, i * step) <= 0.0) {
            low = (i - 1) * step, high = i * step;
            break;
        }
        low = i * step;
    }
    if (high < far || radial_slope(dense, count, far) <= 0.0) {
        for (int i = 0; i < HALVINGS; ++i) {
            const double middle = 0.5 * (low + high);
            (radial_slope(dense, count, middle) > 0.0 ? low : high) = middle;
        }
    }
    return low;
}

}  // namespace ceres_cal
