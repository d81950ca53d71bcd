// The Python module: the functions of the kernels. `kernels/__init__.py` describes what each does and takes.
#if defined(_MSC_VER)
#define NOMINMAX
#include <windows.h>
#endif

#include "arguments.hpp"
#include "inverse.hpp"
#include "planes.hpp"
#include "profiles.hpp"
#include "saddles.hpp"
#include "strands.hpp"
#include "strokes.hpp"
#include "sums.hpp"

namespace ceres_cal {
namespace {

using Bounds = Array<const int64_t, N>;
using Poses = Read<N, 3, 4>;

// Runs work without Python's lock.
template <class Work>
auto unlocked(Work work) {
    const nb::gil_scoped_release release;
    return work();
}

void lens_images(Tuple optics, const Read<N, 3>& rays, const Filled<2, 4, N>& images) {
    const int64_t count = static_cast<int64_t>(rays.shape(0));
    require(images.shape(2) == rays.shape(0), "images are of as many rays");
    const OpticsGiven given(optics);
    const std::unique_ptr<Lens> made = given.make();
    unlocked([&] {
        Rays chunk;
        Image seen;
        const Lane* own[8] = {&seen.x, &seen.xx, &seen.xy, &seen.xz, &seen.y, &seen.yx, &seen.yy, &seen.yz};
        for (int64_t first = 0; first < count; first += CHUNK) {
            const int n = static_cast<int>(std::min<int64_t>(CHUNK, count - first));
            const int filled = (n + LANES - 1) / LANES * LANES;
            for (int i = 0; i < filled; ++i) {
                const double* ray = row(rays, first + std::min(i, n - 1));
                chunk.x[i] = ray[0], chunk.y[i] = ray[1], chunk.z[i] = ray[2];
            }
            made->project(filled, chunk, seen);
            for (int k = 0; k < 8; ++k) std::copy_n(own[k]->value, n, images.data() + k * count + first);
        }
    });
}

void lens_rays(Tuple optics, const Read<N, 2>& offsets, double longest, const Filled<N, 3>& rays) {
    const int64_t count = static_cast<int64_t>(offsets.shape(0));
    require(rays.shape(0) == offsets.shape(0), "rays are as many as offsets");
    const OpticsGiven given(optics);
    const std::unique_ptr<Lens> made = given.make();
    unlocked([&] {
        RaySearch sought;
        for (int64_t first = 0; first < count; first += CHUNK)
            sought.find(*made, static_cast<int>(std::min<int64_t>(CHUNK, count - first)), row(offsets, first), longest,
                        row(rays, first));
    });
}

void inverse_of_growing(const Read<N, N>& above, double width, const Read<N>& below, double limit,
                        const Read<N>& targets, const Filled<N>& places) {
    const size_t pieces = above.shape(0), terms = above.shape(1);
    require(pieces > 0 && terms > 0 && width > 0.0, "above: polynomials of a width are needed");
    require(places.size() == targets.size(), "targets and places are (N,)");
    unlocked([&] {
        const MonotonicMap map(whole(pieces), whole(terms), above.data(), width, whole(below.size()), below.data(),
                               limit);
        double last = 1.0, before = 1.0;  // place / target: targets along a line change it evenly
        for (size_t i = 0; i < targets.size(); ++i) {
            const double target = targets.data()[i], place = map.inverse(target, (2.0 * last - before) * target);
            places.data()[i] = place;
            before = last, last = place > 0.0 ? place / target : 1.0;
        }
    });
}

void plane_homographies(const Bounds& bounds, const Read<N, 2>& plane, const Read<N, 2>& offsets,
                        const Read<N>& profile, double unit, double wrong, const Filled<N, 3, 3>& homographies,
                        const Filled<N>& errors) {
    const size_t rows = plane.shape(0);
    require(offsets.shape(0) == rows && errors.size() == rows, "plane, offsets and errors are of as many points");
    Homographies fits(profile.data(), whole(profile.size()), unit, wrong);
    require(bounds.size() == homographies.shape(0) + 1, "bounds: one more than there are homographies is needed");
    const int64_t sights = static_cast<int64_t>(homographies.shape(0)), *first = bounds.data();
    check_bounds(bounds, 0, sights, rows);
    unlocked([&] {
        for (int64_t g = 0, k = first[0]; g < sights; k = first[++g])
            if (const int64_t n = first[g + 1] - k; n > 0)
                fits.fit(n, row(plane, k), row(offsets, k), row(homographies, g), row(errors, k));
    });
}

void radial_alignment(const Bounds& bounds, const Read<N, 2>& plane, const Read<N, 2>& offsets, double unit, int rounds,
                      const Filled<N>& profile, const Filled<N>& errors, const Filled<N>& usual) {
    const size_t rows = plane.shape(0), terms = profile.size();
    require(offsets.shape(0) == rows && errors.size() == rows && usual.size() == rows,
            "plane, offsets, errors and usual are of as many points");
    require(bounds.size() > 0 && bounds.data()[0] == 0, "bounds: they begin with 0");
    require(terms > 0 && terms <= Alignment::MOST_TERMS, "profile: one to four coefficients");
    const int64_t sights = static_cast<int64_t>(bounds.size()) - 1;
    check_bounds(bounds, 0, sights, rows);
    unlocked([&] {
        Alignment alignment(sights, bounds.data(), plane.data(), offsets.data(), unit, whole(terms));
        for (int round = 0; round < rounds; ++round) alignment.fit(profile.data(), errors.data(), usual.data());
    });
}

void factor(const Read<N, N>& normal, const Filled<N, N>& upper) {
    const size_t size = normal.shape(0);
    require(normal.shape(1) == size && upper.shape(0) == size && upper.shape(1) == size, "normal and upper are (K, K)");
    unlocked([&] { cholesky(whole(size), normal.data(), whole(size), upper.data()); });
}

void loss_weights(Tuple given, const Read<N>& squared, const Filled<N>& weights) {
    const Loss loss = loss_given(given);
    require(weights.size() == squared.size(), "squared and weights are (N,)");
    unlocked([&] {
        with_loss(loss.code, [&](auto code) {
            for (size_t i = 0; i < squared.size(); ++i)
                weights.data()[i] = robust<decltype(code)::value>(loss.scale, squared.data()[i]).slope;
        });
    });
}

void normal_cdf(const Read<N>& x, const Filled<N>& shares) {
    require(shares.size() == x.size(), "x and shares are (N,)");
    unlocked([&] {
        for (size_t i = 0; i < x.size(); ++i) shares.data()[i] = 0.5 * std::erfc(-x.data()[i] / std::sqrt(2.0));
    });
}

double normal_share(double z) {
    constexpr double least = -8.5, most = 8.5;  // standard deviations beyond which less than 1e-17 lies
    return z > most ? 1.0 : z < least ? 0.0 : 0.5 * std::erfc(-z / std::sqrt(2.0));
}

void mixture_above(const Read<N>& weights, const Read<N, N>& means, const Read<N, N>& scales, const Bounds& columns,
                   const Read<N>& places, const Filled<N>& above) {
    const size_t parts = means.shape(0), width = means.shape(1), count = columns.size();
    require(weights.size() == parts && scales.shape(0) == parts && scales.shape(1) == width,
            "weights are (F,), means and scales (F, N)");
    require(places.size() == count && above.size() == count, "columns, places and above are (K,)");
    const int64_t *at = columns.data(), *last = at + count;
    require(std::all_of(at, last, [&](int64_t i) { return i >= 0 && i < static_cast<int64_t>(width); }),
            "columns: numbers of means");
    unlocked([&] {
        std::fill_n(above.data(), count, 0.0);
        for (size_t part = 0; part < parts; ++part) {
            const double *mean = means.data() + part * width, *scale = scales.data() + part * width;
            for (size_t k = 0; k < count; ++k)
                above.data()[k] += weights.data()[part] * normal_share((mean[at[k]] - places.data()[k]) * scale[at[k]]);
        }
    });
}

bool block(Tuple optics, Tuple unknowns, Tuple points, Tuple curves, Tuple loss, Tuple at, const Filled<N>& residuals,
           Tuple jacobians) {
    Seen seen(0, 1, optics, unknowns, points, curves, loss);
    const Unknowns& own = seen.unknowns;
    const Read<N> camera = array<Read<N>>(at[0], "at.camera");
    const Read<6> station = array<Read<6>>(at[1], "at.station"), placement = array<Read<6>>(at[2], "at.placement");
    require(whole(camera.size()) == own.count || own.count == 0, "at: camera has a number for each that is free");
    for (int k = 0; k < own.count; ++k) seen.optics.intrinsics[static_cast<size_t>(own.free[k])] = camera.data()[k];
    require(whole(residuals.size()) == own.size(), "residuals: one for each number, and one");
    Filled<N> kept[4];
    const auto filled = [&](int k, int size) -> double* {
        kept[k] = array<Filled<N>>(jacobians[k], "jacobians");
        if (kept[k].size() == 0) return nullptr;
        require(whole(kept[k].size()) == own.size() * size, "jacobians: (residuals, numbers of the block)");
        return kept[k].data();
    };
    double* const blocks[4] = {filled(0, own.count), filled(1, 6), filled(2, 6), filled(3, own.structure)};
    const std::unique_ptr<Lens> made = seen.optics.make();
    return unlocked([&] {
        return evaluate_block(*made, own, seen.observed, station.data(), placement.data(), residuals.data(), blocks);
    });
}

void eliminate_placements(int64_t first, int64_t last, Tuple optics, Tuple unknowns, Tuple points, Tuple curves,
                          Tuple loss, bool newton, double tolerance, const Read<N>& change, Tuple sweep) {
    const Seen seen(first, last, optics, unknowns, points, curves, loss);
    const auto poses = array<Filled<N, 3, 4>>(sweep[0], "sweep.poses");
    const auto gains = array<Filled<N, 6, N>>(sweep[1], "sweep.gains");
    const auto costs = array<Filled<N>>(sweep[2], "sweep.costs");
    const auto reduced = array<Filled<N, N>>(sweep[3], "sweep.reduced");
    const size_t shared = static_cast<size_t>(seen.unknowns.shared()), sights = poses.shape(0);
    require(last <= static_cast<int64_t>(sights), "sweep: there are fewer poses");
    require(gains.shape(0) == sights && costs.size() == sights, "sweep: poses, gains and costs are as many");
    require(change.size() == shared && gains.shape(2) == shared && reduced.shape(0) == shared + 1 &&
                reduced.shape(1) == shared + 1,
            "change is (K,) of the shared numbers, gains (S, 6, K), reduced (K + 1, K + 1)");
    const std::unique_ptr<Lens> made = seen.optics.make();
    unlocked([&] {
        Elimination elimination(*made, seen.unknowns, seen.observed, newton);
        const Sweep filled{poses.data(), gains.data(), costs.data(), reduced.data()};
        for (int64_t v = first; v < last; ++v) elimination.eliminate(v, tolerance, change.data(), filled);
    });
}

void sight_normals(int64_t first, int64_t last, Tuple optics, Tuple unknowns, Tuple points, Tuple curves, Tuple loss,
                   bool newton, const Poses& poses, const Read<N>& units, const Filled<N>& costs,
                   const Filled<N, N, N>& normals) {
    const Seen seen(first, last, optics, unknowns, points, curves, loss);
    const size_t size = static_cast<size_t>(seen.unknowns.size()), asked = static_cast<size_t>(last - first);
    require(costs.size() == asked && normals.shape(0) == asked, "costs and normals are of as many sights");
    require(poses.shape(0) >= static_cast<size_t>(last), "there are fewer poses");
    require(units.size() == size && normals.shape(1) == size && normals.shape(2) == size,
            "units are (K,), normals (S, K, K)");
    const std::unique_ptr<Lens> made = seen.optics.make();
    unlocked([&] {
        Sums sums(*made, seen.unknowns, seen.observed);
        for (int64_t v = first; v < last; ++v) {
            double* normal = row(normals, v - first);
            costs.data()[v - first] = sums.normal_equations(v, row(poses, v), newton, normal);
            for (size_t i = 0; i < size; ++i) {
                for (size_t j = 0; j <= i; ++j)
                    normal[size * j + i] = normal[size * i + j] *= units.data()[i] * units.data()[j];
            }
        }
    });
}

// Calls of_sight(v, projection, pose) for each sight from `first` to `last`; returns false if any call does.
template <class OfSight>
bool each_sight(int64_t first, int64_t last, const OpticsGiven& optics, const Poses& poses, OfSight of_sight) {
    require(poses.shape(0) >= static_cast<size_t>(last), "there are fewer poses");
    const std::unique_ptr<Lens> made = optics.make();
    return unlocked([&] {
        Projection shown(*made);
        bool good = true;
        for (int64_t v = first; v < last; ++v) good &= of_sight(v, shown, row(poses, v));
        return good;
    });
}

// rows: where each observation's residuals go; empty: in order.
template <class Given, int many>
void find_residuals(int64_t first, int64_t last, Tuple optics, const Poses& poses, Tuple columns, const Bounds& rows,
                    const Filled<N, many>& residuals) {
    const Given seen(columns, first, last, INT32_MAX);
    const int64_t room = static_cast<int64_t>(residuals.shape(0)), *places = rows.size() > 0 ? rows.data() : nullptr;
    require(rows.size() == seen.count() || (rows.size() == 0 && residuals.shape(0) == seen.count()),
            "rows are (N,), residuals as many without them");
    for (int64_t k = first < last ? seen.view.bounds[first] : 0; first < last && k < seen.view.bounds[last]; ++k)
        require(places == nullptr || (places[k] >= 0 && places[k] < room), "rows: there are fewer residuals");
    each_sight(first, last, OpticsGiven(optics), poses, [&](int64_t v, Projection& shown, const double* pose) {
        return residuals_of(v, shown, pose, seen.view, places, residuals.data());
    });
}

// normals: only for curves.
template <class Given, int many>
bool find_rows(Tuple optics, const Poses& poses, Tuple columns, const Filled<N, many, N>& rows,
               const Filled<N, 2>& normals) {
    const int64_t sights = static_cast<int64_t>(poses.shape(0));
    const OpticsGiven camera(optics);
    const Given seen(columns, 0, sights, INT32_MAX);
    seen.require_directions();
    require(rows.shape(0) == seen.count() && rows.shape(2) == camera.intrinsics.size() + 6 + BUILT,
            "rows are (N, residuals, intrinsics + 6 + 10)");
    require(normals.shape(0) == (many == 1 ? seen.count() : 0), "normals are (M, 2) of curves");
    return each_sight(0, sights, camera, poses, [&](int64_t v, Projection& shown, const double* pose) {
        return rows_of(v, shown, pose, seen.view, rows.data(), normals.data());
    });
}

void fit_saddles(const Array<const float, N, N>& levels, const Read<N, Saddles::START>& starts,
                 const Filled<N, Saddles::FITTED>& fitted) {
    require(starts.shape(0) == fitted.shape(0), "starts and fitted are of as many corners");
    unlocked([&] {
        Saddles saddles({levels.data(), static_cast<int64_t>(levels.shape(0)), static_cast<int64_t>(levels.shape(1))});
        for (int64_t k = 0; k < static_cast<int64_t>(starts.shape(0)); ++k) saddles.fit(row(starts, k), row(fitted, k));
    });
}

void profile_equations(const Read<N, N>& distance, const Read<N, N>& values, const Read<N, N>& edges,
                       const Read<N, 4>& shapes, const Read<N, N>& heights, int free, const Filled<N, N, N>& normals,
                       const Filled<N, N>& rights) {
    const size_t windows = values.shape(0), count = edges.shape(1);
    const bool moves = heights.shape(0) > 0;
    require(distance.shape(0) == windows && distance.shape(1) == values.shape(1) && edges.shape(0) == windows &&
                shapes.shape(0) == windows && (!moves || heights.shape(0) == windows) && heights.shape(1) == count,
            "distance and values are (N, K), edges and heights (N, E), shapes (N, 4)");
    require(free >= 0 && free <= 3, "free: none to three of blur, stretch and smear");
    bool smears = false;
    for (size_t k = 0; k < windows; ++k) smears |= row(shapes, static_cast<int64_t>(k))[1] != 0.0;
    ProfileEquations equations(whole(count), moves, free, smears);
    const size_t size = static_cast<size_t>(equations.size());
    require(normals.shape(0) == windows && normals.shape(1) == size && normals.shape(2) == size &&
                rights.shape(0) == windows && rights.shape(1) == size,
            "normals are (N, P, P), rights (N, P)");
    unlocked([&] {
        for (int64_t k = 0; k < static_cast<int64_t>(windows); ++k) {
            const double* const shape = row(shapes, k);
            const Blurred at{shape[0], shape[1], shape[2], shape[3], row(edges, k), moves ? row(heights, k) : nullptr};
            equations.add_up(at, row(distance, k), row(values, k), static_cast<int64_t>(values.shape(1)),
                             row(normals, k), row(rights, k));
        }
    });
}

void shares_along(const Array<const float, 3, N>& planes, const Array<const float, N>& weights,
                  const Array<const float, N, 2, 3>& axes, double least, const Filled<N>& shares) {
    require(weights.size() == planes.shape(1) && shares.size() == axes.shape(0),
            "planes are (3, N), weights (N,), axes (B, 2, 3), shares (B,)");
    unlocked([&] {
        for (int64_t k = 0; k < static_cast<int64_t>(shares.size()); ++k)
            shares.data()[k] = share_along(whole(weights.size()), planes.data(), weights.data(), row(axes, k),
                                           row(axes, k) + 3, static_cast<float>(least));
    });
}

void lines_near(const Array<const float, N, N>& plane, int reduced, const Array<const float, 7>& optics,
                const Array<const float, 3, N>& along, const Array<const bool, N>& joined,
                const Array<const float, N, 3>& feet, const Filled<N, 3>& sums) {
    require(joined.size() == along.shape(1) && (joined.size() == 0 || !joined.data()[0]) && reduced > 0,
            "along is (3, P), joined (P,) and not the first");
    require(sums.shape(0) == feet.shape(0), "feet and sums are (K, 3)");
    const float* const o = optics.data();
    unlocked([&] {
        const NearnessMap near{plane.data(), static_cast<int64_t>(plane.shape(0)), static_cast<int64_t>(plane.shape(1)),
                               static_cast<float>(reduced)};
        VisibleLines shown(near, {o[0], o[1], o[2], o[3], o[4], o[5], o[6]}, whole(joined.size()), along.data(),
                           joined.data());
        for (int64_t k = 0; k < static_cast<int64_t>(feet.shape(0)); ++k) shown.add_up(row(feet, k), row(sums, k));
    });
}

int64_t strands_left(const Read<N, N>& values, const Bounds& bounds, const Bounds& group, const Read<N, N, N>& rows,
                     const Read<N>& shares, const Filled<N>& logs, const Filled<N, N, N>& left) {
    const size_t shapes = values.shape(0), size = rows.shape(0), strands = rows.shape(1), numbers = rows.shape(2);
    require(values.shape(1) == size && numbers > Strands::POSE, "values are (D, M), rows (M, S, Z) with Z over 6");
    require(bounds.size() == shapes + 1 && group.size() == strands, "bounds are (D + 1,), group (S,)");
    const size_t rest = numbers - Strands::POSE, many = shares.size();
    require(logs.size() == many && left.shape(0) == many && left.shape(1) == rest && left.shape(2) == rest,
            "logs are (A,), left (A, Z - 6, Z - 6)");
    check_bounds(bounds, 0, static_cast<int64_t>(shapes), strands);
    int64_t groups = 0;
    for (size_t s = 0; s < strands; ++s) {
        require(group.data()[s] >= 0 && group.data()[s] < INT32_MAX, "group: numbers from 0 on are needed");
        groups = std::max(groups, group.data()[s] + 1);
    }
    return unlocked([&] {
        Strands sums(whole(size), whole(strands), whole(numbers), rows.data(), group.data(), groups, whole(many),
                     shares.data(), logs.data(), left.data());
        for (int64_t d = 0; d < static_cast<int64_t>(shapes); ++d)
            sums.add(static_cast<int>(bounds.data()[d]), static_cast<int>(bounds.data()[d + 1]), row(values, d));
        return sums.eliminate();
    });
}

// Whether there is another build, for processors of x86-64-v3, and this processor can run it.
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

NB_MODULE(CERES_CAL_MODULE, m) {
    m.def("has_avx2", &has_avx2);
    m.def("lens_images", &lens_images);
    m.def("lens_rays", &lens_rays);
    m.def("inverse_of_growing", &inverse_of_growing);
    m.def("plane_homographies", &plane_homographies);
    m.def("radial_alignment", &radial_alignment);
    m.def("cholesky", &factor);
    m.def("loss_weights", &loss_weights);
    m.def("normal_cdf", &normal_cdf);
    m.def("mixture_above", &mixture_above);
    m.def("evaluate_block", &block);
    m.def("eliminate_placements", &eliminate_placements);
    m.def("sight_normals", &sight_normals);
    m.def("point_residuals", &find_residuals<PointsGiven, 2>);
    m.def("curve_residuals", &find_residuals<CurvesGiven, 1>);
    m.def("point_rows", &find_rows<PointsGiven, 2>);
    m.def("fit_saddles", &fit_saddles);
    m.def("profile_equations", &profile_equations);
    m.def("curve_rows", &find_rows<CurvesGiven, 1>);
    m.def("shares_along", &shares_along);
    m.def("lines_near", &lines_near);
    m.def("strands_left", &strands_left);
}

}  // namespace ceres_cal
