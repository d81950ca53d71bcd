// The normal equations of one sight: robust weights, weighted rows, their products (design, section 6).
#pragma once

#include <limits>
#include <vector>

#include "observations.hpp"
#include "projection.hpp"

namespace ceres_cal {

constexpr double NO_ANSWER = std::numeric_limits<double>::quiet_NaN();

// The derivative by a motion along a direction of the target's frame, from the derivatives by the camera's x, y and z:
// a motion of the target along it moves the point by R times it.
inline double along(const double* by_camera, const double* pose, const double* direction) {
    double sum = 0.0;
    for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) sum += by_camera[j] * pose[4 * j + k] * direction[k];
    return sum;
}

class Sums {
  public:
    Sums(Lens& lens, const Unknowns& unknowns, const Observed& seen)
        : unknowns_(unknowns),
          seen_(seen),
          shown_(lens),
          products_(static_cast<size_t>(unknowns.size() + 3) * static_cast<size_t>(unknowns.size() + 3)) {
        own_.reserve(unknowns.size()), places_.reserve(unknowns.size());
    }

    // Returns the sum of rho over a sight, NaN if an observation cannot be projected. A is added up in the lower
    // triangle of `normal`, of the unknowns' size squared.
    //
    // newton: whether A includes rho'', for a step, or only rho', as the weight of each observation.
    double normal_equations(int64_t sight, const double* pose, bool newton, double* normal) {
        std::fill_n(normal, static_cast<size_t>(unknowns_.size()) * unknowns_.size(), 0.0);
        pose_ = pose, newton_ = newton, normal_ = normal, cost_ = 0.0;
        with_loss(seen_.loss.code, [&](auto code) {
            const auto of = [&](const auto& columns) {
                all_chunks(columns, sight,
                           [&](auto... chunk) { return add<decltype(code)::value>(columns, chunk...); });
            };
            of(seen_.points), of(seen_.curves);
        });
        return cost_;
    }

  private:
    template <LossCode code, class Columns>
    bool add(const Columns& seen, int64_t start, int n) {
        constexpr int MANY = Columns::RESIDUALS;
        if (!shown_.show(start, n, pose_, seen)) return cost_ = NO_ANSWER, false;
        choose_rows();
        const int filled = shown_.rows.n, last = static_cast<int>(own_.size()) - 1;
        for (int i = 0; i < filled; ++i) weight_[i] = i < n ? seen.weights[start + i] : 0.0;
        double *error = own_[last], cost = 0.0;
        each(filled, [&](int i) {
            const double w = weight_[i], ex = w * (MANY == 2 ? shown_.off_x(i) : shown_.distance(i));
            const double ey = MANY == 2 ? w * shown_.off_y(i) : 0.0, squared = ex * ex + ey * ey;
            const Robust one = robust<code>(seen_.loss.scale, squared);
            const double root = std::sqrt(one.slope), factor = root * w;
            bend_[i] = one.bend;
            if constexpr (code == LossCode::cauchy)
                rho_[i] = one.rho;
            else
                cost += one.rho;
            factor_[i] = MANY == 2 ? factor : factor * shown_.normal_x[i];
            factor_[filled + i] = MANY == 2 ? factor : factor * shown_.normal_y[i];
            error[i] = root * ex;
            if (MANY == 2) error[filled + i] = root * ey;
        });
        if (code == LossCode::cauchy) cost = seen_.loss.scale * seen_.loss.scale * sum_of_logs(filled, rho_.value);
        for (int k = 0; k < last; ++k) {
            double* own = own_[k];
            if constexpr (MANY == 2)
                each(2 * filled, [=](int i) { own[i] *= factor_[i]; });
            else
                each(filled, [=](int i) { own[i] = factor_[i] * own[i] + factor_[filled + i] * own[filled + i]; });
        }
        if (newton_) bend_rows<code, MANY>(n);
        add_rows(MANY * filled);
        for (int i = 0; i < n && seen.slots != nullptr; ++i) {
            double directions[BUILT][3] = {};
            shown_.directions(seen, start + i, i, directions);
            add_structure<Columns>(i, seen.slots + Columns::MOVED * seen.moved(start + i), directions);
        }
        return cost_ += cost, true;
    }

    // Chooses the chunk's rows that take part, and their rows in A. Numbers on which the chunk does not depend, as most
    // of a lens with local coefficients, are left out.
    void choose_rows() {
        shown_.differentiate(unknowns_.count == 0);
        own_.clear(), places_.clear();
        for (int k = 0; k < unknowns_.count; ++k) {
            if (!shown_.rows.shown[unknowns_.free[k]]) continue;
            own_.push_back(shown_.rows.x(static_cast<int>(unknowns_.free[k]))), places_.push_back(k);
        }
        for (int k = 0; k < 7; ++k)
            own_.push_back(shown_.rows.x(shown_.pose_row + k)), places_.push_back(unknowns_.shared() + k);
    }

    // normal += P P^T over the first n columns of the rows, lower triangle.
    void add_rows(int n) {
        const int count = static_cast<int>(own_.size()), size = unknowns_.size(), stride = count + 3;
        find_products(own_.data(), count, n, products_.data());
        for (int k = 0; k < count; ++k) {
            double* own = normal_ + size * places_[k];
            for (int j = 0; j <= k; ++j) own[places_[j]] += products_[stride * k + j];
        }
    }

    // Includes the second derivative of rho in the rows: Newton's step on the loss, with unchanged gradient.
    template <LossCode code, int MANY>
    void bend_rows(int n) {
        constexpr double FLAT = 0.7, MOSTLY_FLAT = 0.5;  // a bend; share of such bends above which they mean nothing
        if constexpr (code != LossCode::huber && code != LossCode::soft_l1) return;
        const int filled = shown_.rows.n, last = static_cast<int>(own_.size()) - 1;
        double *error_x = own_[last], *error_y = error_x + filled;
        const auto flat = std::count_if(bend_.value, bend_.value + n, [](double bend) { return bend < FLAT; });
        for (int i = 0; i < n && static_cast<double>(flat) <= MOSTLY_FLAT * n; ++i) {
            if (bend_[i] == 1.0) continue;
            const double ex = error_x[i], ey = MANY == 2 ? error_y[i] : 0.0, length2 = ex * ex + ey * ey;
            for (int k = 0; k < last; ++k) {
                double &x = own_[k][i], &y = own_[k][filled + i];
                const double share = (1.0 - bend_[i]) * (ex * x + ey * y) / length2;
                x -= share * ex, y -= share * ey;
            }
            error_x[i] /= bend_[i], error_y[i] /= bend_[i];
        }
    }

    // Adds the share of the chunk's observation i in the rows of the structure numbers `slots` (-1: none) that move it.
    template <class Columns>
    void add_structure(int i, const int32_t* slots, const double (&directions)[BUILT][3]) {
        const int filled = shown_.rows.n, count = static_cast<int>(own_.size()), size = unknowns_.size();
        for (int c = 0; c < Columns::RESIDUALS; ++c) {
            const auto row = [&](int k) { return own_[k][c * filled + i]; };
            const double by_place[3] = {row(count - 4), row(count - 3), row(count - 2)};
            double column[BUILT];
            for (int a = 0; a < Columns::MOVED; ++a) {
                if (slots[a] < 0) continue;
                const auto add = [&](int place, int other, double value) {
                    normal_[size * std::max(place, other) + std::min(place, other)] += column[a] * value;
                };
                const int place = unknowns_.count + slots[a];
                column[a] = along(by_place, pose_, directions[a]);
                for (int k = 0; k < count; ++k) add(place, places_[k], row(k));
                for (int b = 0; b <= a; ++b)
                    if (slots[b] >= 0) add(place, unknowns_.count + slots[b], column[b]);
            }
        }
    }

    const Unknowns unknowns_;
    const Observed& seen_;
    const double* pose_ = nullptr;
    bool newton_ = false;
    double *normal_ = nullptr, cost_ = 0.0;
    Projection shown_;
    Lane weight_, bend_, rho_;
    alignas(64) double factor_[2 * CHUNK];
    std::vector<double*> own_;
    std::vector<int> places_;
    std::vector<double> products_;  // with room for three more rows and columns
};

// ---- single observations, in px: residuals, and the Jacobian of which the sums are made ----

// Calls of_chunk(start, n) for all chunks of a sight; if it fails for a chunk, for each of its observations alone; and
// none(k) where that fails, too. Returns false if any chunk failed.
template <class Columns, class Chunk, class None>
inline bool one_by_one_where_some_fail(const Columns& seen, int64_t sight, Chunk of_chunk, None none) {
    return all_chunks(seen, sight, [&](int64_t start, int n) {
        const bool good = of_chunk(start, n);
        for (int64_t k = start; !good && k < start + n; ++k)
            if (!of_chunk(k, 1)) none(k);
        return good;
    });
}

// Computes the residuals of one sight, project(X) - p for points and the signed distances from pixels to curves, into
// the rows `rows` of residuals (null: in order); NaN, and false, where there is none. s is moved to the foot.
template <class Columns>
inline bool residuals_of(int64_t sight, Projection& shown, const double* pose, const Columns& seen, const int64_t* rows,
                         double* residuals) {
    constexpr int MANY = Columns::RESIDUALS;
    const auto place = [&](int64_t k) { return residuals + MANY * (rows != nullptr ? rows[k] : k); };
    const auto of_chunk = [&](int64_t start, int n) {
        if (!shown.show(start, n, pose, seen)) return false;
        for (int i = 0; i < n; ++i) {
            double* own = place(start + i);
            own[0] = MANY == 2 ? shown.off_x(i) : shown.distance(i);
            if (MANY == 2) own[1] = shown.off_y(i);
        }
        return true;
    };
    return one_by_one_where_some_fail(seen, sight, of_chunk,
                                      [&](int64_t k) { std::fill_n(place(k), MANY, NO_ANSWER); });
}

// Computes d residual / d [intrinsics | 6 pose | offsets of the observation, BUILT] of one sight into `rows`, RESIDUALS
// rows for each observation; NaN, and false, where there is none. normals: for curves (M, 2), filled with the image
// normal at the foot.
template <class Columns>
inline bool rows_of(int64_t sight, Projection& shown, const double* pose, const Columns& seen, double* rows,
                    double* normals) {
    constexpr int MANY = Columns::RESIDUALS;
    const int numbers = shown.last_row, size = numbers + BUILT;
    const auto place = [&](int64_t k) { return rows + MANY * size * k; };
    const auto of_chunk = [&](int64_t start, int n) {
        if (!shown.show(start, n, pose, seen)) return false;
        double* row = place(start);
        shown.differentiate(false);
        for (int k = 0; k < shown.pose_row; ++k) shown.rows.open(k);
        for (int i = 0; i < n; ++i) {
            const double nx = MANY == 1 ? shown.normal_x[i] : 0.0, ny = MANY == 1 ? shown.normal_y[i] : 0.0;
            if (MANY == 1) normals[2 * (start + i)] = nx, normals[2 * (start + i) + 1] = ny;
            double directions[BUILT][3] = {};
            shown.directions(seen, start + i, i, directions);
            for (int c = 0; c < MANY; ++c, row += size) {
                for (int k = 0; k < numbers; ++k) {
                    const double x = shown.rows.x(k)[i], y = shown.rows.y(k)[i];
                    row[k] = MANY == 1 ? nx * x + ny * y : (c == 0 ? x : y);
                }
                for (int a = 0; a < BUILT; ++a) row[numbers + a] = along(row + numbers - 3, pose, directions[a]);
            }
        }
        return true;
    };
    return one_by_one_where_some_fail(
        seen, sight, of_chunk, [&](int64_t k) { std::fill_n(place(k), static_cast<size_t>(MANY) * size, NO_ANSWER); });
}

}  // namespace ceres_cal
