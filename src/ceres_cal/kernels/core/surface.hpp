// A surface of cubic B-splines on a grid: see surface.py.
//
// Among the intrinsics, from the place `at` on: half the grid's width and height, in the lens's units, then the
// coefficients of the x and the y displacement of each node, column after column.
#pragma once

#include <algorithm>

#include "lens.hpp"

namespace ceres_cal {

class Surface {
  public:
    static constexpr int COLUMNS = 16, ROWS = 12, HEAD = 2, COUNT = HEAD + 2 * COLUMNS * ROWS;

    // What displaces a place: x and y, and their derivatives by the place's u and v.
    struct Displacement {
        double x = 0.0, y = 0.0, xu = 0.0, xv = 0.0, yu = 0.0, yv = 0.0;
    };

    Surface(int at, const Numbers& intrinsics)
        : at_(at),
          nodes_(intrinsics.from(at, COUNT) + HEAD),
          wide_(side(intrinsics[at])),
          high_(side(intrinsics[at + 1])) {}

    const Displacement& look_up(int i, double u, double v) {
        Place& place = places_[i];
        place.first = cell(u / wide_, COLUMNS, 1.0 / wide_, place.along, place.along_slope) * ROWS;
        place.first += cell(v / high_, ROWS, 1.0 / high_, place.down, place.down_slope);
        Displacement& sum = place.sum = {};
        for (int j = 0; j < 4; ++j) {
            const double* node = nodes_ + 2 * (place.first + j * ROWS);
            double a = 0.0, b = 0.0, a_slope = 0.0, b_slope = 0.0;
            for (int k = 0; k < 4; ++k) {
                a += place.down[k] * node[2 * k], b += place.down[k] * node[2 * k + 1];
                a_slope += place.down_slope[k] * node[2 * k], b_slope += place.down_slope[k] * node[2 * k + 1];
            }
            sum.x += place.along[j] * a, sum.y += place.along[j] * b;
            sum.xu += place.along_slope[j] * a, sum.yu += place.along_slope[j] * b;
            sum.xv += place.along[j] * a_slope, sum.yv += place.along[j] * b_slope;
        }
        place.u = u, place.v = v;
        return sum;
    }

    // Derivatives of the pixels that were looked up last by the numbers of the surface.
    void differentiate(int count, double unit, double aspect, const Rows& rows) const {
        for (int k = 0; k < HEAD; ++k) rows.open(at_ + k);
        for (int i = 0; i < count; ++i) {
            const Place& place = places_[i];
            const double by_wide = -unit * place.u / wide_, by_high = -unit * place.v / high_;
            rows.x(at_)[i] = by_wide * place.sum.xu, rows.y(at_)[i] = aspect * by_wide * place.sum.yu;
            rows.x(at_ + 1)[i] = by_high * place.sum.xv, rows.y(at_ + 1)[i] = aspect * by_high * place.sum.yv;
            for (int j = 0; j < 4; ++j)
                for (int k = 0; k < 4; ++k) {
                    const int row = at_ + HEAD + 2 * (place.first + j * ROWS + k);
                    const double weight = unit * place.along[j] * place.down[k];
                    rows.open(row), rows.open(row + 1);
                    rows.x(row)[i] = weight, rows.y(row + 1)[i] = aspect * weight;
                }
        }
    }

  private:
    struct Place {
        int first;  // of the sixteen nodes
        double u, v, along[4], along_slope[4], down[4], down_slope[4];
        Displacement sum;
    };

    static double side(double given) { return given > 0.0 ? given : 1.0; }  // 0: not set yet, and nothing is displaced

    // Of a place from -1 to 1: the first of the four nodes, their weights, and the slopes of these (0 beyond).
    static int cell(double place, int count, double per_side, double* weight, double* slope) {
        const double cells = 0.5 * (count - 3),
                     inside = std::min(1.0, std::max(-1.0, place));  // a number, whatever the place
        const int first = std::min(static_cast<int>((inside + 1.0) * cells), count - 4);
        const double t = (inside + 1.0) * cells - first, rest = 1.0 - t;
        const double per = inside == place ? cells * per_side : 0.0;
        weight[0] = rest * rest * rest / 6.0;
        weight[1] = (3.0 * t - 6.0) * t * t / 6.0 + 2.0 / 3.0;
        weight[2] = ((3.0 - 3.0 * t) * t + 3.0) * t / 6.0 + 1.0 / 6.0;
        weight[3] = t * t * t / 6.0;
        slope[0] = -0.5 * rest * rest * per;
        slope[1] = (1.5 * t - 2.0) * t * per;
        slope[2] = ((1.0 - 1.5 * t) * t + 0.5) * per;
        slope[3] = 0.5 * t * t * per;
        return first;
    }

    int at_;
    const double* nodes_;  // the caller's, who keeps them
    double wide_, high_;
    Place places_[CHUNK];
};

}  // namespace ceres_cal
