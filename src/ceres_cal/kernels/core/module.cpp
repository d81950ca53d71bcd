// The module: Python's doors to the kernels. calls.py says what each does, and arguments.py what it takes.
#if defined(_MSC_VER)
#define NOMINMAX
#include <windows.h>
#endif

#include "alignment.hpp"
#include "arguments.hpp"
#include "rows.hpp"

namespace ceres_cal {
namespace {

using Numbers1 = Array<const double, 1>;
using Numbers2 = Array<const double, 2>;
using Numbers3 = Array<const double, 3>;
using Filled1 = Array<double, 1>;
using Filled2 = Array<double, 2>;
using Filled3 = Array<double, 3>;
using Whole1 = Array<const int64_t, 1>;

// What is run without Python's lock.
template <class Work>
auto unlocked(Work work) {
    const nb::gil_scoped_release release;
    return work();
}

// Groups of rows: their number, each from bounds[g] to bounds[g + 1].
int64_t groups_of(const Whole1& bounds, size_t rows) {
    require(bounds.shape(0) >= 1, "bounds: one more than groups are needed");
    const int64_t count = static_cast<int64_t>(bounds.shape(0)) - 1;
    check_bounds(bounds, 0, count, rows);
    return count;
}

Aligned sight_of(const Whole1& bounds, int64_t g, const Numbers2& x, const Numbers2& p, const double* weights) {
    const int64_t start = bounds.data()[g], n = bounds.data()[g + 1] - start;
    return {n, x.data() + start, x.data() + x.shape(1) + start, p.data() + 2 * start, weights + start};
}

void require_poses(const Numbers3& poses, size_t sights) {
    require(has_shape(poses, {poses.shape(0), 3, 4}) && poses.shape(0) >= sights, "poses are (S, 3, 4)");
}

void align_sights(Whole1 bounds, Numbers2 x, Numbers2 p, Numbers1 weights, Filled2 h12, Filled3 shares,
                  Filled2 reduced) {
    const size_t rows = p.shape(0), columns = reduced.shape(0);
    const int64_t sights = groups_of(bounds, rows);
    require(has_shape(x, {2, rows}) && has_shape(p, {rows, 2}) && weights.shape(0) == rows,
            "x is (2, N), p (N, 2), weights (N,)");
    require(has_shape(h12, {static_cast<size_t>(sights), 6}) && has_shape(reduced, {columns, columns}) &&
                columns >= 1 && has_shape(shares, {static_cast<size_t>(sights), 3, columns}),
            "h12 is (S, 6), shares (S, 3, C), reduced (C, C)");
    unlocked([&] {
        for (int64_t g = 0; g < sights; ++g) {
            const Aligned seen = sight_of(bounds, g, x, p, weights.data());
            align(seen, h12.data() + 6 * g);
            add_depths(seen, h12.data() + 6 * g, whole(columns), shares.data() + 3 * columns * static_cast<size_t>(g),
                       reduced.data());
        }
    });
}

void find_alignment_errors(Whole1 bounds, Numbers2 x, Numbers2 p, Numbers2 h12, Numbers2 h3, Numbers1 profile,
                           Filled1 errors) {
    const size_t rows = p.shape(0);
    const int64_t sights = groups_of(bounds, rows);
    require(has_shape(x, {2, rows}) && has_shape(p, {rows, 2}) && errors.shape(0) == rows,
            "x is (2, N), p (N, 2), errors (N,)");
    require(has_shape(h12, {static_cast<size_t>(sights), 6}) && has_shape(h3, {static_cast<size_t>(sights), 3}),
            "h12 is (S, 6), h3 (S, 3)");
    unlocked([&] {
        for (int64_t g = 0; g < sights; ++g)
            alignment_errors(sight_of(bounds, g, x, p, nullptr), h12.data() + 6 * g, h3.data() + 3 * g, profile.data(),
                             whole(profile.shape(0)), errors.data() + bounds.data()[g]);
    });
}

void normalised_planes(Whole1 bounds, Numbers2 plane, Filled2 x, Filled2 lifts) {
    const size_t rows = plane.shape(0);
    const int64_t sights = groups_of(bounds, rows);
    require(
        has_shape(plane, {rows, 2}) && has_shape(x, {2, rows}) && has_shape(lifts, {static_cast<size_t>(sights), 3}),
        "plane is (N, 2), x (2, N), lifts (S, 3)");
    unlocked([&] {
        for (int64_t g = 0; g < sights; ++g) {
            const int64_t start = bounds.data()[g], n = bounds.data()[g + 1] - start;
            normalise(n, plane.data() + 2 * start, x.data() + start, x.data() + rows + start, lifts.data() + 3 * g);
        }
    });
}

void find_usual_by_radius(Numbers1 errors, Numbers1 radius, Filled1 usual) {
    const size_t rows = errors.shape(0);
    require(radius.shape(0) == rows && usual.shape(0) == rows, "errors, radius and usual are (N,)");
    unlocked([&] { usual_by_radius(static_cast<int64_t>(rows), errors.data(), radius.data(), usual.data()); });
}

void plane_homographies(Whole1 bounds, Numbers2 plane, Numbers2 offsets, Numbers1 profile, double unit, double wrong,
                        Filled3 homographies, Filled1 errors) {
    const size_t rows = plane.shape(0);
    const int64_t sights = groups_of(bounds, rows);
    require(has_shape(plane, {rows, 2}) && has_shape(offsets, {rows, 2}) && errors.shape(0) == rows,
            "plane and offsets are (N, 2), errors (N,)");
    require(has_shape(homographies, {static_cast<size_t>(sights), 3, 3}), "homographies are (S, 3, 3)");
    unlocked([&] {
        Homographies fits(profile.data(), whole(profile.shape(0)), unit, wrong);
        for (int64_t g = 0; g < sights; ++g) {
            const int64_t start = bounds.data()[g], n = bounds.data()[g + 1] - start;
            if (n > 0)
                fits.fit(n, plane.data() + 2 * start, offsets.data() + 2 * start, homographies.data() + 9 * g,
                         errors.data() + start);
        }
    });
}

void grouped_scatter(Numbers2 values, Whole1 bounds, Filled3 scatter) {
    const size_t size = values.shape(1);
    const int64_t groups = groups_of(bounds, values.shape(0));
    require(has_shape(scatter, {static_cast<size_t>(groups), size, size}), "scatter is (G, K, K)");
    unlocked([&] {
        for (int64_t g = 0; g < groups; ++g) {
            const int64_t start = bounds.data()[g];
            scatter_of(bounds.data()[g + 1] - start, static_cast<int64_t>(size),
                       values.data() + static_cast<int64_t>(size) * start,
                       scatter.data() + size * size * static_cast<size_t>(g));
        }
    });
}

void factor(Numbers2 normal, Filled2 upper) {
    const size_t size = normal.shape(0);
    require(has_shape(normal, {size, size}) && has_shape(upper, {size, size}), "normal and upper are (K, K)");
    unlocked([&] { cholesky(whole(size), normal.data(), whole(size), upper.data()); });
}

void loss_weights(const nb::tuple& given, Numbers1 squared, Filled1 weights) {
    const Loss loss = loss_given(given);
    const size_t rows = squared.shape(0);
    require(weights.shape(0) == rows, "squared and weights are (N,)");
    unlocked([&] {
        with_loss(loss.code, [&](auto code) {
            for (size_t i = 0; i < rows; ++i)
                weights.data()[i] = robust<decltype(code)::value>(loss.scale, squared.data()[i]).slope;
            return 0;
        });
    });
}

// What all kernels of sights take, checked.
struct Seen {
    OpticsGiven optics;
    UnknownsGiven unknowns;
    PointsGiven points;
    CurvesGiven curves;
    Loss loss;

    Seen(const nb::tuple& optics, const nb::tuple& unknowns, const nb::tuple& points, const nb::tuple& curves,
         const nb::tuple& loss)
        : optics(optics),
          unknowns(unknowns, this->optics.intrinsics().size()),
          points(points),
          curves(curves),
          loss(loss_given(loss)) {
        this->points.need_weights(), this->curves.need_weights();
    }
};

double* block_of(const nb::tuple& blocks, size_t k, size_t rows, size_t size, std::vector<Filled1>& kept) {
    kept.push_back(array<double, 1>(blocks[k], "jacobians"));
    if (kept.back().shape(0) == 0) return nullptr;
    require(kept.back().shape(0) == rows * size, "jacobians: as many rows as residuals times the block's size");
    return kept.back().data();
}

bool block(const nb::tuple& optics, const nb::tuple& unknowns, const nb::tuple& points, const nb::tuple& curves,
           const nb::tuple& loss, const nb::tuple& at, Filled1 residuals, const nb::tuple& jacobians) {
    Seen seen(optics, unknowns, points, curves, loss);
    const Unknowns& own = seen.unknowns.view;
    const Numbers1 camera = array<const double, 1>(at[0], "at.camera"),
                   station = array<const double, 1>(at[1], "at.station"),
                   placement = array<const double, 1>(at[2], "at.placement");
    require(station.shape(0) == 6 && placement.shape(0) == 6, "at: station and placement are (6,)");
    require(whole(camera.shape(0)) == own.count || own.count == 0, "at: camera has a number for each that is free");
    for (int k = 0; k < own.count; ++k) seen.optics.intrinsics()[static_cast<size_t>(own.free[k])] = camera.data()[k];
    const size_t rows = static_cast<size_t>(own.size());
    require(residuals.shape(0) == rows, "residuals: one for each number, and one");
    std::vector<Filled1> kept;
    kept.reserve(4);
    const Jacobians filled{block_of(jacobians, 0, rows, static_cast<size_t>(own.count), kept),
                           block_of(jacobians, 1, rows, 6, kept), block_of(jacobians, 2, rows, 6, kept),
                           block_of(jacobians, 3, rows, static_cast<size_t>(own.structure), kept)};
    const Points of_points = seen.points.view(0, 1, own.structure);
    const Curves of_curves = seen.curves.view(0, 1, own.structure);
    const Optics made = seen.optics.make();
    return unlocked([&] {
        return evaluate_block(made, own, of_points, of_curves, seen.loss, station.data(), placement.data(),
                              residuals.data(), filled);
    });
}

void eliminate_placements(int64_t first, int64_t last, const nb::tuple& optics, const nb::tuple& unknowns,
                          const nb::tuple& points, const nb::tuple& curves, const nb::tuple& loss, bool newton,
                          double tolerance, Numbers1 change, const nb::tuple& sweep) {
    Seen seen(optics, unknowns, points, curves, loss);
    const Unknowns& own = seen.unknowns.view;
    const Filled3 poses = array<double, 3>(sweep[0], "sweep.poses"), gains = array<double, 3>(sweep[1], "sweep.gains");
    const Filled1 costs = array<double, 1>(sweep[2], "sweep.costs");
    const Filled2 reduced = array<double, 2>(sweep[3], "sweep.reduced");
    const size_t shared = static_cast<size_t>(own.shared()), sights = poses.shape(0);
    require(change.shape(0) == shared, "change: one for each shared number");
    require(last <= static_cast<int64_t>(sights) && has_shape(poses, {sights, 3, 4}) &&
                has_shape(gains, {sights, 6, shared}) && costs.shape(0) == sights &&
                has_shape(reduced, {shared + 1, shared + 1}),
            "sweep: poses are (S, 3, 4), gains (S, 6, K), costs (S,), reduced (K + 1, K + 1)");
    const Points of_points = seen.points.view(first, last, own.structure);
    const Curves of_curves = seen.curves.view(first, last, own.structure);
    const Optics made = seen.optics.make();
    unlocked([&] {
        Elimination elimination(made, own, of_points, of_curves, seen.loss, newton);
        const Sweep filled{poses.data(), gains.data(), costs.data(), reduced.data()};
        for (int64_t v = first; v < last; ++v) elimination.eliminate(v, tolerance, change.data(), filled);
    });
}

void sight_normals(int64_t first, int64_t last, const nb::tuple& optics, const nb::tuple& unknowns,
                   const nb::tuple& points, const nb::tuple& curves, const nb::tuple& loss, bool newton, Numbers3 poses,
                   Numbers1 units, Filled1 costs, Filled3 normals) {
    Seen seen(optics, unknowns, points, curves, loss);
    const Unknowns& own = seen.unknowns.view;
    const size_t size = static_cast<size_t>(own.size());
    require(first >= 0 && first <= last, "sights: the last comes after the first");
    require_poses(poses, static_cast<size_t>(last));
    const size_t sights = static_cast<size_t>(last - first);
    require(units.shape(0) == size && costs.shape(0) == sights && has_shape(normals, {sights, size, size}),
            "units are (K,), costs (S,), normals (S, K, K)");
    const Points of_points = seen.points.view(first, last, own.structure);
    const Curves of_curves = seen.curves.view(first, last, own.structure);
    const Optics made = seen.optics.make();
    unlocked([&] {
        Sums sums(made, own);
        for (size_t v = 0; v < sights; ++v) {
            double* normal = normals.data() + size * size * v;
            const int64_t sight = first + static_cast<int64_t>(v);
            costs.data()[v] = sums.normal_equations(sight, poses.data() + 12 * sight, of_points, of_curves, seen.loss,
                                                    newton, normal);
            for (size_t i = 0; i < size; ++i) {
                for (size_t j = 0; j <= i; ++j) normal[size * i + j] *= units.data()[i] * units.data()[j];
                for (size_t j = 0; j < i; ++j) normal[size * j + i] = normal[size * i + j];
            }
        }
    });
}

void find_point_residuals(int64_t first, int64_t last, const nb::tuple& optics, Numbers3 poses, const nb::tuple& points,
                          Whole1 rows, Filled2 residuals) {
    OpticsGiven camera(optics);
    const PointsGiven seen(points);
    require(first >= 0, "sights: the first is 0");
    require_poses(poses, static_cast<size_t>(last));
    require(rows.shape(0) == seen.count() && has_shape(residuals, {residuals.shape(0), 2}),
            "rows are (N,), residuals (R, 2)");
    const Points view = seen.view(first, last, INT32_MAX);
    for (int64_t k = first < last ? view.bounds[first] : 0; first < last && k < view.bounds[last]; ++k)
        require(rows.data()[k] >= 0 && rows.data()[k] < static_cast<int64_t>(residuals.shape(0)),
                "rows: there are fewer residuals");
    const Optics made = camera.make();
    unlocked([&] {
        Projection shown(made);
        for (int64_t v = first; v < last; ++v)
            point_residuals(v, shown, poses.data() + 12 * v, view, rows.data(), residuals.data());
    });
}

void find_curve_residuals(const nb::tuple& optics, Numbers3 poses, const nb::tuple& curves, Filled1 residuals) {
    OpticsGiven camera(optics);
    const CurvesGiven seen(curves);
    require_poses(poses, 0);
    require(residuals.shape(0) == seen.count(), "residuals are (M,)");
    const int64_t sights = static_cast<int64_t>(poses.shape(0));
    const Curves view = seen.view(0, sights, INT32_MAX);
    const Optics made = camera.make();
    unlocked([&] {
        Projection shown(made);
        for (int64_t v = 0; v < sights; ++v) curve_residuals(v, shown, poses.data() + 12 * v, view, residuals.data());
    });
}

void find_point_rows(const nb::tuple& optics, Numbers3 poses, const nb::tuple& points, Filled3 rows) {
    OpticsGiven camera(optics);
    const PointsGiven seen(points);
    seen.need_bends();
    require_poses(poses, 0);
    require(has_shape(rows, {seen.count(), 2, camera.intrinsics().size() + 6 + BUILT}),
            "rows are (N, 2, intrinsics + 6 + 7)");
    const int64_t sights = static_cast<int64_t>(poses.shape(0));
    const Points view = seen.view(0, sights, INT32_MAX);
    const Optics made = camera.make();
    unlocked([&] {
        Projection shown(made);
        for (int64_t v = 0; v < sights; ++v) point_rows(v, shown, poses.data() + 12 * v, view, rows.data());
    });
}

bool find_curve_rows(const nb::tuple& optics, Numbers3 poses, const nb::tuple& curves, Filled2 rows, Filled2 normals) {
    OpticsGiven camera(optics);
    const CurvesGiven seen(curves);
    require_poses(poses, 0);
    require(has_shape(rows, {seen.count(), camera.intrinsics().size() + 6 + BUILT}) &&
                has_shape(normals, {seen.count(), 2}),
            "rows are (M, intrinsics + 6 + 7), normals (M, 2)");
    const int64_t sights = static_cast<int64_t>(poses.shape(0));
    const Curves view = seen.view(0, sights, INT32_MAX);
    const Optics made = camera.make();
    return unlocked([&] {
        Projection shown(made);
        bool good = true;
        for (int64_t v = 0; v < sights; ++v)
            good &= curve_rows(v, shown, poses.data() + 12 * v, view, rows.data(), normals.data());
        return good;
    });
}

// Whether the other build, for processors of x86-64-v3, runs here, and there is one.
bool has_avx2() {
#if !defined(CERES_CAL_HAS_V3)
    return false;
#elif defined(__GNUC__)
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
    return IsProcessorFeaturePresent(PF_AVX2_INSTRUCTIONS_AVAILABLE) != 0;
#endif
}

}  // namespace

// A copy of an array that is to be filled would be filled in its place: it is taken as it is, or refused.
NB_MODULE(CERES_CAL_MODULE, m) {
    using namespace nb::literals;
    m.def("has_avx2", &has_avx2);
    m.def("align_sights", &align_sights, "bounds"_a, "x"_a, "p"_a, "weights"_a, "h12"_a.noconvert(),
          "shares"_a.noconvert(), "reduced"_a.noconvert());
    m.def("alignment_errors", &find_alignment_errors, "bounds"_a, "x"_a, "p"_a, "h12"_a, "h3"_a, "profile"_a,
          "errors"_a.noconvert());
    m.def("normalised_planes", &normalised_planes, "bounds"_a, "plane"_a, "x"_a.noconvert(), "lifts"_a.noconvert());
    m.def("usual_by_radius", &find_usual_by_radius, "errors"_a, "radius"_a, "usual"_a.noconvert());
    m.def("plane_homographies", &plane_homographies, "bounds"_a, "plane"_a, "offsets"_a, "profile"_a, "unit"_a,
          "wrong"_a, "homographies"_a.noconvert(), "errors"_a.noconvert());
    m.def("grouped_scatter", &grouped_scatter, "values"_a, "bounds"_a, "scatter"_a.noconvert());
    m.def("cholesky", &factor, "normal"_a, "upper"_a.noconvert());
    m.def("loss_weights", &loss_weights, "loss"_a, "squared"_a, "weights"_a.noconvert());
    m.def("evaluate_block", &block, "optics"_a, "unknowns"_a, "points"_a, "curves"_a, "loss"_a, "at"_a,
          "residuals"_a.noconvert(), "jacobians"_a);
    m.def("eliminate_placements", &eliminate_placements, "first"_a, "last"_a, "optics"_a, "unknowns"_a, "points"_a,
          "curves"_a, "loss"_a, "newton"_a, "tolerance"_a, "change"_a, "sweep"_a);
    m.def("sight_normals", &sight_normals, "first"_a, "last"_a, "optics"_a, "unknowns"_a, "points"_a, "curves"_a,
          "loss"_a, "newton"_a, "poses"_a, "units"_a, "costs"_a.noconvert(), "normals"_a.noconvert());
    m.def("point_residuals", &find_point_residuals, "first"_a, "last"_a, "optics"_a, "poses"_a, "points"_a, "rows"_a,
          "residuals"_a.noconvert());
    m.def("curve_residuals", &find_curve_residuals, "optics"_a, "poses"_a, "curves"_a, "residuals"_a.noconvert());
    m.def("point_rows", &find_point_rows, "optics"_a, "poses"_a, "points"_a, "rows"_a.noconvert());
    m.def("curve_rows", &find_curve_rows, "optics"_a, "poses"_a, "curves"_a, "rows"_a.noconvert(),
          "normals"_a.noconvert());
}

}  // namespace ceres_cal
