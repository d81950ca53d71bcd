// Checked arguments from Python in the form that the kernels take: see `kernels/__init__.py`.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <string>

#include "block.hpp"
#include "brown.hpp"
#include "elimination.hpp"
#include "kannala_brandt.hpp"
#include "python_lens.hpp"
#include "radial.hpp"
#include "spline.hpp"

namespace ceres_cal {

constexpr nb::ssize_t N = -1;  // an axis of any length

template <class Number, nb::ssize_t... axes>
using Array = nb::ndarray<Number, nb::shape<axes...>, nb::c_contig, nb::device::cpu>;

// Read: copied if it has another layout or type of numbers. Filled: used as it is, or refused.
template <nb::ssize_t... axes>
using Read = Array<const double, axes...>;
template <nb::ssize_t... axes>
struct Filled : Array<double, axes...> {};

}  // namespace ceres_cal

namespace nanobind::detail {

template <ssize_t... axes>
struct type_caster<ceres_cal::Filled<axes...>> {
    using Whole = make_caster<ceres_cal::Array<double, axes...>>;
    NB_TYPE_CASTER(ceres_cal::Filled<axes...>, Whole::Name)
    bool from_python(handle given, uint32_t flags, cleanup_list* cleanup) noexcept {
        Whole found;  // never a copy, which would be filled instead of the caller's array
        if (!found.from_python(given, flags & ~static_cast<uint32_t>(cast_flags::convert), cleanup)) return false;
        value = {std::move(found.value)};
        return true;
    }
};

}  // namespace nanobind::detail

namespace ceres_cal {

using Tuple = const nb::tuple&;

inline void require(bool good, const char* what) {
    if (!good) throw nb::value_error(what);
}

inline int whole(size_t number) { return static_cast<int>(number); }

// A tuple's array; `name` is for the error.
template <class Of>
Of array(nb::handle given, const char* name) {
    Of found;
    if (!nb::try_cast(given, found, true))
        throw nb::type_error(
            (std::string(name) + ": " + nb::detail::make_caster<Of>::Name.text + " is needed").c_str());
    return found;
}

template <class Of>
auto* row(const Of& array, int64_t number) {
    return array.data() + number * array.stride(0);
}

// The optics of a camera, with a compiled lens, or with one that exists only in Python.
struct OpticsGiven {
    nb::object lens;
    std::string kind;
    Read<N> form;
    double unit;
    std::vector<double> intrinsics;

    explicit OpticsGiven(Tuple given)
        : lens(given[0]),
          kind(nb::cast<std::string>(given[1])),
          form(array<Read<N>>(given[2], "form")),
          unit(nb::cast<double>(given[4])) {
        const Read<N> own = array<Read<N>>(given[3], "intrinsics");
        require(own.size() >= 5, "intrinsics: phi, aspect, cx, cy, coefficients and skew are needed");
        intrinsics.assign(own.data(), own.data() + own.size());
    }

    std::unique_ptr<Lens> make() const {
        const int count = whole(intrinsics.size()) - 1;
        const Making from{{form.data(), whole(form.size())}, {intrinsics.data(), count}, intrinsics.back(), unit};
        if (kind == "radial") return std::make_unique<Radial>(from);
        if (kind == "brown") return std::make_unique<Brown>(from);
        if (kind == "kannala-brandt") return std::make_unique<KannalaBrandt>(from);
        if (kind == "spline") return std::make_unique<Spline>(from);
        nb::ndarray<nb::numpy, const double, nb::ndim<1>> own(intrinsics.data() + 4, {intrinsics.size() - 5});
        return std::make_unique<PythonLens>(lens.attr("with_scaled")(own.cast(nb::rv_policy::copy), unit), from);
    }
};

// Checks the bounds of groups of rows, each from bounds[g] to bounds[g + 1].
inline void check_bounds(const Array<const int64_t, N>& bounds, int64_t first, int64_t last, size_t rows) {
    require(first >= 0 && last < static_cast<int64_t>(bounds.size()), "there are fewer sights than that");
    for (int64_t v = first; v < last; ++v) require(bounds.data()[v] <= bounds.data()[v + 1], "bounds: must not fall");
    require(first >= last || (bounds.data()[first] >= 0 && bounds.data()[last] <= static_cast<int64_t>(rows)),
            "bounds: there are fewer observations than that");
}

// The columns of the sights from `first` to `last`, and the arrays that own their data.
template <int moved>
struct Columns {
    Array<const int64_t, N> bounds;
    Read<N, 2> pixels;
    Read<N> weights;
    Array<const int32_t, N, moved> slots;

    Columns(nb::handle of_bounds, nb::handle of_pixels, nb::handle of_weights, nb::handle of_slots, int64_t first,
            int64_t last, int structure)
        : bounds(array<decltype(bounds)>(of_bounds, "bounds")),
          pixels(array<decltype(pixels)>(of_pixels, "pixels")),
          weights(array<decltype(weights)>(of_weights, "weights")),
          slots(array<decltype(slots)>(of_slots, "slots")) {
        check_bounds(bounds, first, last, count());
        require(weights.size() == count() || weights.size() == 0, "weights are one for each observation, or none");
        for (size_t k = 0; k < slots.size(); ++k)
            require(slots.data()[k] < structure, "slots: there are fewer structure numbers than that");
    }

    size_t count() const { return pixels.shape(0); }
    const int32_t* slots_or_null() const { return slots.size() > 0 ? slots.data() : nullptr; }
};

struct PointsGiven : Columns<BUILT> {
    Read<N, 3> places;
    Read<N, BUILT - 2> bends;
    Points view;

    PointsGiven(Tuple given, int64_t first, int64_t last, int structure)
        : Columns(given[0], given[2], given[3], given[4], first, last, structure),
          places(array<Read<N, 3>>(given[1], "places")),
          bends(array<Read<N, BUILT - 2>>(given[5], "bends")),
          view{bounds.data(), places.data(), pixels.data(), weights.data(), slots_or_null(), bends.data()} {
        require(places.shape(0) == count(), "points: places are as many as pixels");
        require(slots.size() == 0 || slots.shape(0) == count(), "points: slots are as many as pixels, or none");
        if (slots.size() > 0) require_directions();
    }
    void require_directions() const { require(bends.shape(0) == count(), "points: slots need their bends"); }
};

struct CurvesGiven : Columns<ON_TRACK> {
    Read<N, 3, 3> tracks;
    Array<const bool, N> is_arc;
    Array<const int32_t, N> track;
    Filled<N> feet;
    Curves view;

    CurvesGiven(Tuple given, int64_t first, int64_t last, int structure)
        : Columns(given[0], given[4], given[5], given[7], first, last, structure),
          tracks(array<Read<N, 3, 3>>(given[1], "tracks")),
          is_arc(array<Array<const bool, N>>(given[2], "is_arc")),
          track(array<Array<const int32_t, N>>(given[3], "track")),
          feet(array<Filled<N>>(given[6], "feet")),
          view{bounds.data(), tracks.data(),  is_arc.data(), track.data(),
               pixels.data(), weights.data(), feet.data(),   slots_or_null()} {
        const int64_t many = static_cast<int64_t>(tracks.shape(0));
        require(feet.size() == count() && track.size() == count(), "curves: feet and track are as many as pixels");
        require(is_arc.size() == tracks.shape(0), "curves: is_arc is as many as tracks");
        require(slots.size() == 0 || slots.shape(0) == tracks.shape(0), "curves: slots are as many as tracks, or none");
        for (int64_t k = first < last ? view.bounds[first] : 0; first < last && k < view.bounds[last]; ++k)
            require(view.track[k] >= 0 && view.track[k] < many, "curves: there are fewer tracks than that");
    }
    void require_directions() const {}  // a track has its own direction
};

inline Loss loss_given(Tuple given) {
    const int code = nb::cast<int>(given[0]);
    require(code >= 0 && code <= static_cast<int>(LossCode::tukey), "loss: there is no such code");
    return {static_cast<LossCode>(code), nb::cast<double>(given[1])};
}

// The arguments of the solve's kernels for the sights from `first` to `last`.
struct Seen {
    OpticsGiven optics;
    Array<const int64_t, N> free;
    Unknowns unknowns;
    PointsGiven points;
    CurvesGiven curves;
    Observed observed;

    Seen(int64_t first, int64_t last, Tuple camera, Tuple numbers, Tuple on_points, Tuple on_curves, Tuple robust)
        : optics(camera),
          free(array<Array<const int64_t, N>>(numbers[0], "unknowns.free")),
          unknowns{free.data(), whole(free.size()), nb::cast<int>(numbers[1])},
          points(on_points, first, last, unknowns.structure),
          curves(on_curves, first, last, unknowns.structure),
          observed{points.view, curves.view, loss_given(robust)} {
        for (int k = 0; k < unknowns.count; ++k)
            require(unknowns.free[k] >= 0 && unknowns.free[k] < static_cast<int64_t>(optics.intrinsics.size()),
                    "unknowns: there is no such intrinsic");
        require(unknowns.structure >= 0, "unknowns: fewer structure numbers than none");
        require(points.weights.size() == points.count(), "points: weights are needed");
        require(curves.weights.size() == curves.count(), "curves: weights are needed");
    }
};

}  // namespace ceres_cal
