// Homographies of very many sights of points at once, each reweighted against its own wrong labels.
#pragma once

#include <cstdint>
#include <vector>

#include "dense.hpp"

namespace ceres_cal {

// The median of at least one number; it reorders them.
inline double median(std::vector<double>& values) {
    const auto half = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    const auto before = [](double a, double b) { return a < b || (b != b && a == a); };  // NaN comes last
    std::nth_element(values.begin(), half, values.end(), before);
    return values.size() % 2 == 1 ? *half : 0.5 * (*std::max_element(values.begin(), half, before) + *half);
}

// The eigenvector of the least eigenvalue of `normal` (SIZE squared, lower triangle), by inverse iteration from h.
template <int SIZE>
void least_direction(double* normal, double* h, int rounds) {
    double upper[SIZE * SIZE], trace = 0.0;
    for (int i = 0; i < SIZE; ++i) trace += normal[(SIZE + 1) * i];
    for (int i = 0; i < SIZE; ++i) normal[(SIZE + 1) * i] += 1e-13 * trace;
    cholesky(SIZE, normal, SIZE, upper);
    for (int round = 0; round < rounds; ++round) {
        substitute(SIZE, upper, h);
        double squared = 0.0;
        for (int i = 0; i < SIZE; ++i) squared += h[i] * h[i];
        for (int i = 0; i < SIZE; ++i) h[i] /= std::sqrt(squared);
    }
}

class Homographies {
  public:
    // profile: c_k of w = 1 + sum c_k r^2k, with q = (p, w); p and r are offsets and their lengths over `unit`. wrong:
    // multiple of the median error above which an error is a wrong label's.
    Homographies(const double* profile, int terms, double unit, double wrong)
        : profile_(profile), terms_(terms), unit_(unit), wrong_(wrong) {}

    // Computes H (3, 3) of one sight with q ~ H (x, y, 1), with the sign of most of its points, and errors (n).
    void fit(int64_t n, const double* plane, const double* offsets, double* homography, double* errors) {
        constexpr int PATIENCE = 8;  // rounds of reweighting where some points do not fit
        for (std::vector<double>* one : {&x_, &y_, &a_, &b_, &c_}) one->resize(static_cast<size_t>(n));
        weights_.assign(static_cast<size_t>(n), 1.0);
        double lift[3], normal[81], h[9];
        load(n, plane, offsets, lift);
        for (int i = 0; i < 9; ++i) h[i] = 1.0 + 0.1 * i;  // any start: its other components vanish soon
        for (int round = 0; round < PATIENCE; ++round) {
            add_moments(n, normal);
            least_direction<9>(normal, h, 4);
            judge(n, h, errors);
            ordered_.assign(errors, errors + n);
            const double usual = median(ordered_), worst = *std::max_element(errors, errors + n);
            if (worst <= wrong_ * usual) break;
            for (int64_t i = 0; i < n; ++i) {
                const double far = errors[i] / (1.5 * usual + 1e-12);
                weights_[i] /= 1.0 + far * far;
            }
        }
        for (int j = 0; j < 3; ++j) {
            const double a = h[3 * j] * lift[2], b = h[3 * j + 1] * lift[2];
            homography[3 * j] = a, homography[3 * j + 1] = b;
            homography[3 * j + 2] = h[3 * j + 2] - a * lift[0] - b * lift[1];
        }
    }

  private:
    // x and y: the plane's points with centroid 0 and unit spread. lift (3): centroid and 1 / spread. Also computes q.
    void load(int64_t n, const double* plane, const double* offsets, double* lift) {
        double spread = 0.0;
        lift[0] = lift[1] = 0.0;
        for (int64_t i = 0; i < 2 * n; ++i) lift[i % 2] += plane[i] / static_cast<double>(n);
        for (int64_t i = 0; i < n; ++i) {
            x_[i] = plane[2 * i] - lift[0], y_[i] = plane[2 * i + 1] - lift[1];
            spread += x_[i] * x_[i] + y_[i] * y_[i];
            const double a = a_[i] = offsets[2 * i] / unit_, b = b_[i] = offsets[2 * i + 1] / unit_;
            c_[i] = 0.0;
            for (int k = terms_ - 1; k >= 0; --k) c_[i] = (c_[i] + profile_[k]) * (a * a + b * b);
            c_[i] += 1.0;
        }
        lift[2] = 1.0 / (std::sqrt(spread / static_cast<double>(n)) + 1e-12);
        for (int64_t i = 0; i < n; ++i) x_[i] *= lift[2], y_[i] *= lift[2];
    }

    // normal (9, 9), lower triangle, of q_w (h1 . X) - q_x (h3 . X) = 0 and q_w (h2 . X) - q_y (h3 . X) = 0.
    void add_moments(int64_t n, double* normal) const {
        constexpr int PLACES[5][2] = {{0, 0}, {3, 3}, {6, 0}, {6, 3}, {6, 6}};
        constexpr int PRODUCTS[3][3] = {{0, 1, 3}, {1, 2, 4}, {3, 4, 5}};
        double sums[5][6] = {};
        const double *x = x_.data(), *y = y_.data(), *qa = a_.data(), *qb = b_.data(), *qc = c_.data();
        for (int64_t i = 0; i < n; ++i) {
            const double w = weights_[i], a = qa[i], b = qb[i], c = qc[i], ww = w * c * c;
            const double factor[5] = {ww, ww, -w * c * a, -w * c * b, w * (a * a + b * b)};
            const double product[6] = {x[i] * x[i], x[i] * y[i], y[i] * y[i], x[i], y[i], 1.0};
            for (int f = 1; f < 5; ++f)
                for (int p = 0; p < 6; ++p) sums[f][p] += factor[f] * product[p];
        }
        std::copy_n(sums[1], 6, sums[0]);
        std::fill_n(normal, 81, 0.0);
        for (int f = 0; f < 5; ++f) {
            for (int j = 0; j < 3; ++j)
                for (int k = 0; k < 3; ++k) normal[9 * (PLACES[f][0] + j) + PLACES[f][1] + k] = sums[f][PRODUCTS[j][k]];
        }
    }

    // Distance of each measured point from its image under h, in the unit of q, and 1 / depth^2 as weights.
    void judge(int64_t n, double* h, double* errors) {
        int64_t agree = 0;
        for (int64_t i = 0; i < n; ++i) {
            const double x = x_[i], y = y_[i], u = h[0] * x + h[1] * y + h[2], v = h[3] * x + h[4] * y + h[5];
            const double depth = h[6] * x + h[7] * y + h[8], away = std::abs(depth) > 1e-9 ? depth : 1e-9;
            agree += u * a_[i] + v * b_[i] + depth * c_[i] > 0.0 ? 1 : -1;
            const double dx = u * c_[i] / away - a_[i], dy = v * c_[i] / away - b_[i];
            errors[i] = std::sqrt(dx * dx + dy * dy);
            weights_[i] = 1.0 / (away * away);
        }
        for (int i = 0; i < 9 && agree < 0; ++i) h[i] = -h[i];
    }

    const double* profile_;
    int terms_;
    double unit_, wrong_;
    std::vector<double> x_, y_, a_, b_, c_, weights_, ordered_;
};

// The profile of a lens from sights of points, for any radial distortion: `closed_forms.radial_alignment` has the
// equations.
class Alignment {
  public:
    // bounds (sights + 1); unit: the px that are the unit of the profile.
    Alignment(int64_t sights, const int64_t* bounds, const double* plane, const double* offsets, double unit, int terms)
        : sights_(sights), bounds_(bounds), terms_(terms), size_(4 + terms) {
        const size_t count = static_cast<size_t>(bounds[sights]);
        for (std::vector<double>* one : {&x_, &y_, &a_, &b_, &r_, &u_, &v_, &q_}) one->resize(count);
        weights_.assign(count, 1.0);
        depths_.resize(static_cast<size_t>(sights * 3 * (terms + 1)));
        double farthest = 0.0;
        for (size_t i = 0; i < count; ++i) {
            a_[i] = offsets[2 * i] / unit, b_[i] = offsets[2 * i + 1] / unit;
            r_[i] = std::sqrt(a_[i] * a_[i] + b_[i] * b_[i]);
            farthest = std::max(farthest, r_[i]);
        }
        // In a ring of few points, its outliers would determine the usual error.
        rings_.resize(std::min<size_t>(std::max<size_t>(count / 200, 1), 16));
        const double rings = static_cast<double>(rings_.size());
        for (size_t i = 0; i < count; ++i)
            rings_[static_cast<size_t>(std::min(r_[i] * rings / (farthest + 1e-300), rings - 1.0))].push_back(i);
        for (int64_t g = 0; g < sights; ++g) load(bounds[g], bounds[g + 1], plane);
    }

    // One round: c (terms) of the profile, each point's error, in units, and the usual error there; and weights from
    // these.
    void fit(double* c, double* errors, double* usual) {
        double reduced[MOST * MOST] = {}, vectors[MOST * MOST];
        for (int64_t g = 0; g < sights_; ++g)
            if (bounds_[g] < bounds_[g + 1]) align(g, reduced);
        // Least squares without undetermined directions.
        double right[MOST], largest = 0.0;
        for (int j = 0; j < terms_; ++j) right[j] = reduced[(terms_ + 1) * j + terms_], c[j] = 0.0;
        for (int j = 1; j < terms_; ++j)
            for (int k = 0; k < terms_; ++k) reduced[terms_ * j + k] = reduced[(terms_ + 1) * j + k];
        eigen(terms_, reduced, vectors);
        for (int j = 0; j < terms_; ++j) largest = std::max(largest, reduced[(terms_ + 1) * j]);
        for (int j = 0; j < terms_; ++j) {
            if (!(reduced[(terms_ + 1) * j] > NOTHING * largest)) continue;
            double along = 0.0;
            for (int k = 0; k < terms_; ++k) along += vectors[terms_ * k + j] * right[k];
            for (int k = 0; k < terms_; ++k) c[k] += vectors[terms_ * k + j] * along / reduced[(terms_ + 1) * j];
        }
        for (int64_t g = 0; g < sights_; ++g) judge(g, c, errors);
        for (const std::vector<size_t>& ring : rings_) {
            if (ring.empty()) continue;
            ordered_.clear();
            for (const size_t i : ring) ordered_.push_back(errors[i]);
            const double here = std::max(median(ordered_), 1e-12);
            for (const size_t i : ring) {
                const double far = errors[i] / (1.5 * here);
                usual[i] = here, weights_[i] = 1.0 / (1.0 + far * far);
            }
        }
    }

    static constexpr int MOST_TERMS = 4;

  private:
    static constexpr int MOST = 4 + MOST_TERMS;
    static constexpr double NOTHING = 1e-10;

    // x and y: the plane's points with centroid 0 and unit spread.
    void load(int64_t first, int64_t last, const double* plane) {
        const double n = static_cast<double>(last - first);
        double centre[2] = {}, spread = 0.0;
        for (int64_t i = first; i < last; ++i) centre[0] += plane[2 * i] / n, centre[1] += plane[2 * i + 1] / n;
        for (int64_t i = first; i < last; ++i) {
            const double x = plane[2 * i] - centre[0], y = plane[2 * i + 1] - centre[1];
            x_[static_cast<size_t>(i)] = x, y_[static_cast<size_t>(i)] = y, spread += x * x + y * y;
        }
        spread = std::sqrt(spread / n) + 1e-12;
        for (size_t i = static_cast<size_t>(first); i < static_cast<size_t>(last); ++i)
            x_[i] /= spread, y_[i] /= spread;
    }

    // h1 and h2 of a sight, its u, v and q, and how its depth follows c; its equations for c are added to `reduced`.
    void align(int64_t g, double* reduced) {
        const size_t first = static_cast<size_t>(bounds_[g]), last = static_cast<size_t>(bounds_[g + 1]);
        double normal[36] = {}, h[6], agree = 0.0, whole = 0.0;
        for (size_t i = first; i < last; ++i) {
            const double w = weights_[i],
                         row[6] = {-b_[i] * x_[i], -b_[i] * y_[i], -b_[i], a_[i] * x_[i], a_[i] * y_[i], a_[i]};
            add_outer(6, w, row, normal);
        }
        for (int j = 0; j < 6; ++j) h[j] = 1.0 + 0.1 * j;  // any start, as above
        least_direction<6>(normal, h, 8);
        for (size_t i = first; i < last; ++i) {
            u_[i] = h[0] * x_[i] + h[1] * y_[i] + h[2], v_[i] = h[3] * x_[i] + h[4] * y_[i] + h[5];
            agree += weights_[i] * (u_[i] * a_[i] + v_[i] * b_[i]), whole += weights_[i] * r_[i] * r_[i];
        }
        const double scale = whole / (std::abs(agree) > 1e-12 ? agree : 1e-12);
        double depths[MOST * MOST] = {}, upper[9], held[9], trace = 0.0;
        for (size_t i = first; i < last; ++i) {
            u_[i] *= scale, v_[i] *= scale;
            q_[i] = (u_[i] * a_[i] + v_[i] * b_[i]) / std::max(r_[i], 1e-9);
            double row[MOST] = {r_[i] * x_[i], r_[i] * y_[i], r_[i]}, power = -q_[i];
            for (int k = 0; k < terms_; ++k) row[3 + k] = power *= r_[i] * r_[i];
            row[3 + terms_] = q_[i];
            add_outer(size_, weights_[i], row, depths);
        }
        mirror(size_, depths);
        for (int j = 0; j < 3; ++j) trace += depths[(size_ + 1) * j];
        for (int j = 0; j < 3; ++j)
            for (int k = 0; k < 3; ++k) held[3 * j + k] = depths[size_ * j + k] + (j == k ? 1e-12 * trace : 0.0);
        cholesky(3, held, 3, upper);
        double* shares = depths_.data() + g * 3 * (terms_ + 1);
        for (int j = 0; j < 3; ++j) std::copy_n(depths + size_ * j + 3, terms_ + 1, shares + (terms_ + 1) * j);
        substitute(3, upper, shares, terms_ + 1);
        for (int j = 0; j <= terms_; ++j)
            for (int k = 0; k <= terms_; ++k) {
                double left = depths[size_ * (3 + j) + 3 + k];
                for (int m = 0; m < 3; ++m) left -= shares[(terms_ + 1) * m + j] * depths[size_ * m + 3 + k];
                reduced[(terms_ + 1) * j + k] += left;
            }
    }

    void judge(int64_t g, const double* c, double* errors) const {
        const double* shares = depths_.data() + g * 3 * (terms_ + 1);
        double third[3];
        for (int j = 0; j < 3; ++j) {
            third[j] = shares[(terms_ + 1) * j + terms_];
            for (int k = 0; k < terms_; ++k) third[j] -= shares[(terms_ + 1) * j + k] * c[k];
        }
        for (size_t i = static_cast<size_t>(bounds_[g]); i < static_cast<size_t>(bounds_[g + 1]); ++i) {
            const double depth = third[0] * x_[i] + third[1] * y_[i] + third[2], r = r_[i];
            const double seen = std::sqrt(u_[i] * u_[i] + v_[i] * v_[i]);
            const double across = r * (a_[i] * v_[i] - b_[i] * u_[i]) / std::max(seen, 1e-9);
            double lift = 0.0;
            for (int k = terms_ - 1; k >= 0; --k) lift = (lift + c[k]) * r * r;
            const double along = r - q_[i] * (1.0 + lift) / (std::abs(depth) > 1e-9 ? depth : 1e-9);
            errors[i] = std::sqrt(across * across + along * along);
        }
    }

    // Adds w row row^T to the lower triangle; and copies that to the upper one.
    static void add_outer(int size, double w, const double* row, double* to) {
        for (int j = 0; j < size; ++j)
            for (int k = 0; k <= j; ++k) to[size * j + k] += w * row[j] * row[k];
    }
    static void mirror(int size, double* matrix) {
        for (int j = 0; j < size; ++j)
            for (int k = 0; k < j; ++k) matrix[size * k + j] = matrix[size * j + k];
    }

    int64_t sights_;
    const int64_t* bounds_;
    int terms_, size_;
    std::vector<double> x_, y_, a_, b_, r_, u_, v_, q_, weights_, depths_, ordered_;
    std::vector<std::vector<size_t>> rings_;
};

}  // namespace ceres_cal
