// A lens without a formula: see spline.py. Places, radii and displacements are in units of the rim, or in the solver's
// unit.
//
// Form: the indices of Conrady's decentring and of the surface in the intrinsics, 0 for none; the table of the
// B-splines' pieces (see b_splines.py), coefficients by power, those of all pieces of an interval side by side; for
// each monomial c q^m conj(q)^n the index of c in the intrinsics, m and n.
#pragma once

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "lens.hpp"

namespace ceres_cal {

// A surface of cubic B-splines on a grid: see surface.py.
//
// Its intrinsics, from the index `at` on, are half the grid's width and height, in the lens's units, then the
// coefficients of the x and the y displacement of each node, column after column.
class Surface {
  public:
    static constexpr int COLUMNS = 16, ROWS = 12, HEAD = 2, COUNT = HEAD + 2 * COLUMNS * ROWS;

    // The displacement of a place, x and y, and its derivatives by the place's u and v.
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

    // Derivatives of the pixels that were looked up last, by the numbers of the surface.
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
        int first;  // the first of the sixteen nodes
        double u, v, along[4], along_slope[4], down[4], down_slope[4];
        Displacement sum;
    };

    static double side(double given) { return given > 0.0 ? given : 1.0; }  // 0: not set yet, without displacements

    // The first of the four nodes of a place from -1 to 1, their weights, and the slopes of these (0 beyond).
    static int cell(double place, int count, double per_side, double* weight, double* slope) {
        const double cells = 0.5 * (count - 3),
                     inside = std::min(1.0, std::max(-1.0, place));  // a number even if the place is NaN
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
    const double* nodes_;  // owned by the caller
    double wide_, high_;
    Place places_[CHUNK];
};

class Spline final : public Lens {
  public:
    explicit Spline(const Making& from)
        : Lens(from),
          rim_(from.intrinsics[4] > 0.0 ? from.intrinsics[4] : 1.0),
          conrady_(static_cast<int>(from.form[0])) {
        const Numbers &form = from.form, &intrinsics = from.intrinsics;
        for (int k = 0; k < 2 * CONRADY && conrady_ > 0; ++k) c_[k] = intrinsics[conrady_ + k] / 3.0;
        if (form[1] > 0.0) surface_ = std::make_unique<Surface>(static_cast<int>(form[1]), intrinsics);
        std::copy_n(form.from(HEAD, TABLE), TABLE, pieces_);
        for (int place = HEAD + TABLE; place < form.count; place += 3) {
            const int at = static_cast<int>(form[place]), m = static_cast<int>(form[place + 1]),
                      n = static_cast<int>(form[place + 2]);
            if (m < 0 || n < 0 || m > MOST || n > MOST) throw std::invalid_argument("spline: powers are 0 to 9");
            monomials_.push_back({at, m, n, intrinsics[at], intrinsics[at + 1]});
            highest_ = std::max({highest_, m, n});
        }
        for (int j = 0; j < INTERVALS; ++j)
            for (int d = 0; d < ORDER; ++d)
                for (int a = j == 0 ? 2 : (j == 1 ? 1 : 0); a < ORDER; ++a)  // value and slope at the axis are 0
                    profile_[j][d] += intrinsics[3 + j + a] * pieces_[(j * ORDER + d) * ORDER + a];
        for (int k = 1; k <= 8 * INTERVALS && limit_ == END; ++k) {
            radius_[0] = k / (8.0 * INTERVALS), add_profile(0);
            if (rim_ + slope_[0] <= 0.0) limit_ = radius_[0];
        }
    }

    bool distort(int n, const Rays& rays, Image& image) override {
        const double scale = 2.0 * phi / (unit * rim_), per_scale = 1.0 / scale, unit = this->unit, rim = rim_;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], length = std::sqrt(x * x + y * y + z * z);
            const double s = scale / (length + z), u = s * x, v = s * y;
            length_[i] = length, s_[i] = s, u_[i] = u, v_[i] = v, radius_[i] = std::sqrt(u * u + v * v);
        });
        add_conrady(n);
        if (!monomials_.empty()) add_monomials(n);
        if (surface_) add_surface(n);
        for (int i = 0; i < n; ++i) add_profile(i);  // in a loop of its own: its look-up prevents SIMD
        int bad = 0;
        each(n, [&](int i) {
            const double x = rays.x[i], y = rays.y[i], z = rays.z[i], u = u_[i], v = v_[i], s = s_[i];
            const double length = length_[i], per_radius = 1.0 / (radius_[i] + TINY), per_length = 1.0 / length;
            const double stretch = value_[i] * per_radius, bend = (slope_[i] - stretch) * per_radius * per_radius;
            // Derivatives by q and by its conjugate are converted to those by x and y.
            const double first_x = first_x_[i] + second_x_[i], first_y = first_y_[i] + second_y_[i];
            const double other_x = first_x_[i] - second_x_[i], other_y = first_y_[i] - second_y_[i];
            const double jxx = rim + stretch + bend * u * u + first_x, jyy = rim + stretch + bend * v * v + other_x;
            const double jxy = bend * u * v - other_y, jyx = bend * u * v + first_y;
            const double f = s * s * per_scale * per_length, ax = s - f * x * x, ab = -f * x * y, by = s - f * y * y;
            image.x[i] = unit * ((rim + stretch) * u + moved_x_[i]),
            image.y[i] = unit * ((rim + stretch) * v + moved_y_[i]);
            image.xx[i] = unit * (jxx * ax + jxy * ab), image.xy[i] = unit * (jxx * ab + jxy * by);
            image.yx[i] = unit * (jyx * ax + jyy * ab), image.yy[i] = unit * (jyx * ab + jyy * by);
            const double along_x = unit * (jxx * u + jxy * v), along_y = unit * (jyx * u + jyy * v);
            image.xz[i] = -along_x * per_length, image.yz[i] = -along_y * per_length;
            along_x_[i] = along_x, along_y_[i] = along_y;
            bad +=
                !((length + z > 1e-9 * length) & (radius_[i] < limit_) & (jxx * jyy > jxy * jyx) & (jxx + jyy > 0.0));
        });
        return bad == 0;
    }

    void differentiate(const Rows& rows) override {
        const double unit = this->unit, aspect = this->aspect, rim = rim_, per_phi = 1.0 / phi;
        const int n = rows.n;
        double *x = rows.x(0), *y = rows.y(0), *rim_x = rows.show(4), *rim_y = rows.y(4);
        each(n, [&](int i) {
            x[i] = along_x_[i] * per_phi, y[i] = aspect * along_y_[i] * per_phi;
            rim_x[i] = unit * u_[i] - along_x_[i] / rim, rim_y[i] = aspect * (unit * v_[i] - along_y_[i] / rim);
        });
        weigh_pieces(rows);
        each(n, [&](int i) {
            const double outward = unit / (radius_[i] + TINY);
            along_x_[i] = outward * u_[i], along_y_[i] = aspect * outward * v_[i];
        });
        for (int row = 5; row < 5 + COUNT; ++row) {
            if (!rows.shown[row]) continue;
            x = rows.x(row), y = rows.y(row);
            each(n, [&](int i) {
                const double value = x[i];
                x[i] = value * along_x_[i], y[i] = value * along_y_[i];
            });
        }
        if (conrady_ > 0) differentiate_conrady(rows);
        for (const Monomial& one : monomials_) {
            const Lane &a_ = power_x_[one.m], &b_ = power_y_[one.m], &c_ = power_x_[one.n], &d_ = power_y_[one.n];
            double *p = rows.show(one.at), *q = rows.show(one.at + 1);
            each(n, [&](int i) {
                const double re = unit * (a_[i] * c_[i] + b_[i] * d_[i]), im = unit * (b_[i] * c_[i] - a_[i] * d_[i]);
                p[i] = re, p[n + i] = aspect * im, q[i] = -im, q[n + i] = aspect * re;
            });
        }
        if (surface_) surface_->differentiate(n, unit, aspect, rows);
    }

  private:
    static constexpr int INTERVALS = 8, DEGREE = 5, ORDER = DEGREE + 1, COUNT = INTERVALS + DEGREE - 2;
    static constexpr int CONRADY = 3, MOST = 9, HEAD = 2, TABLE = INTERVALS * ORDER * ORDER;
    static constexpr double END = 2.0;  // in units of the rim: nothing is observed farther out

    struct Monomial {
        int at, m, n;
        double re, im;
    };

    // The interval of a radius, and the position t in it.
    static int interval(double u, double& t) {
        const double inside = std::min(1.0, u) * INTERVALS;  // a number even if the radius is NaN
        const int j = std::min(static_cast<int>(inside), INTERVALS - 1);
        t = inside - j;
        return j;
    }

    // G and its slope; a straight line beyond the last knot.
    void add_profile(int i) {
        double t = 0.0, slope = 0.0;
        const double* own = profile_[interval(radius_[i], t)];
        double value = own[DEGREE];
        for (int d = DEGREE - 1; d >= 0; --d) slope = slope * t + value, value = value * t + own[d];
        slope_[i] = slope * INTERVALS;
        value_[i] = value + slope_[i] * std::max(radius_[i] - 1.0, 0.0);
    }

    // (2 s C(s) + q^2 conj(C(s))) / 3 with s = |q|^2 and C its three terms, and its derivatives by q and its conjugate.
    void add_conrady(int n) {
        const double a0 = c_[0], b0 = c_[1], a1 = c_[2], b1 = c_[3], a2 = c_[4], b2 = c_[5];
        each(n, [&](int i) {
            const double u = u_[i], v = v_[i], s = u * u + v * v, x = u * u - v * v, y = 2.0 * u * v;
            const double a = a0 + s * (a1 + s * a2), b = b0 + s * (b1 + s * b2);
            const double da = a1 + 2.0 * s * a2, db = b1 + 2.0 * s * b2;
            const double c = 2.0 * (a + s * da), d = 2.0 * (b + s * db);
            const double e = c + da * x + db * y, f = d + da * y - db * x;
            moved_x_[i] = 2.0 * s * a + a * x + b * y, moved_y_[i] = 2.0 * s * b + a * y - b * x;
            first_x_[i] = c * u + d * v + s * (da * u + db * v) + 2.0 * (a * u + b * v);
            first_y_[i] = d * u - c * v + s * (da * v - db * u) + 2.0 * (a * v - b * u);
            second_x_[i] = e * u - f * v, second_y_[i] = e * v + f * u;
        });
    }

    void differentiate_conrady(const Rows& rows) const {
        const int n = rows.n;
        for (int k = 0; k < CONRADY; ++k) {
            double *p = rows.show(conrady_ + 2 * k), *q = rows.show(conrady_ + 2 * k + 1);
            each(n, [&](int i) {
                const double u = u_[i], v = v_[i], x = u * u - v * v, y = 2.0 * u * v, s = u * u + v * v;
                const double size = unit / 3.0 * (k > 0 ? s : 1.0) * (k > 1 ? s : 1.0);
                p[i] = size * (2.0 * s + x), p[n + i] = aspect * size * y;
                q[i] = size * y, q[n + i] = aspect * size * (2.0 * s - x);
            });
        }
    }

    void add_monomials(int n) {
        each(n, [&](int i) { power_x_[0][i] = 1.0, power_y_[0][i] = 0.0; });
        for (int k = 1; k <= highest_; ++k) {
            const Lane &a = power_x_[k - 1], &b = power_y_[k - 1];
            Lane &x = power_x_[k], &y = power_y_[k];
            each(n, [&](int i) { x[i] = a[i] * u_[i] - b[i] * v_[i], y[i] = a[i] * v_[i] + b[i] * u_[i]; });
        }
        for (const Monomial& one : monomials_) {
            add_product(n, 1.0, one, one.m, one.n, moved_x_, moved_y_);
            if (one.m > 0) add_product(n, one.m, one, one.m - 1, one.n, first_x_, first_y_);
            if (one.n > 0) add_product(n, one.n, one, one.m, one.n - 1, second_x_, second_y_);
        }
    }

    // along + i across += factor c q^m conj(q)^p.
    void add_product(int n, double factor, const Monomial& one, int m, int p, Lane& along, Lane& across) const {
        const Lane &a = power_x_[m], &b = power_y_[m], &c = power_x_[p], &d = power_y_[p];
        const double re = factor * one.re, im = factor * one.im;
        each(n, [&](int i) {
            const double x = a[i] * c[i] + b[i] * d[i], y = b[i] * c[i] - a[i] * d[i];
            along[i] += re * x - im * y, across[i] += re * y + im * x;
        });
    }

    void add_surface(int n) {
        for (int i = 0; i < n; ++i) {
            const Surface::Displacement one = surface_->look_up(i, u_[i], v_[i]);
            moved_x_[i] += one.x, moved_y_[i] += one.y;
            first_x_[i] += 0.5 * (one.xu + one.yv), first_y_[i] += 0.5 * (one.yu - one.xv);
            second_x_[i] += 0.5 * (one.xu - one.yv), second_y_[i] += 0.5 * (one.yu + one.xv);
        }
    }

    // The B-splines at each radius, straight beyond the last knot, into the x components of their rows.
    void weigh_pieces(const Rows& rows) const {
        for (int i = 0; i < rows.n; ++i) {
            double t, value[ORDER], slope[ORDER] = {};
            const int j = interval(radius_[i], t);
            const double *own = pieces_ + j * ORDER * ORDER, beyond = INTERVALS * std::max(radius_[i] - 1.0, 0.0);
            for (int a = 0; a < ORDER; ++a) value[a] = own[DEGREE * ORDER + a];
            for (int d = DEGREE - 1; d >= 0; --d)
                for (int a = 0; a < ORDER; ++a) {
                    slope[a] = slope[a] * t + value[a];
                    value[a] = value[a] * t + own[d * ORDER + a];
                }
            for (int a = std::max(2 - j, 0); a < ORDER; ++a) {
                rows.open(3 + j + a);
                rows.x(3 + j + a)[i] = value[a] + beyond * slope[a];
            }
        }
    }

    double rim_, limit_ = END, c_[2 * CONRADY] = {}, profile_[INTERVALS][ORDER] = {}, pieces_[TABLE];
    int conrady_, highest_ = 0;
    std::vector<Monomial> monomials_;
    std::unique_ptr<Surface> surface_;
    Lane length_, s_, u_, v_, radius_, value_, slope_, along_x_, along_y_;
    Lane moved_x_, moved_y_, first_x_, first_y_, second_x_, second_y_;
    Lane power_x_[MOST + 1], power_y_[MOST + 1];
};

}  // namespace ceres_cal
