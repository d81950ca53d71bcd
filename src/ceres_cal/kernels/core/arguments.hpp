// What Python hands over, checked, as the kernels take it: see arguments.py.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include <string>

#include "block.hpp"
#include "elimination.hpp"
#include "lenses.hpp"
#include "python_lens.hpp"

namespace ceres_cal {

constexpr nb::ssize_t N = -1;  // an axis of any length

template <class Number, nb::ssize_t... axes>
using Array = nb::ndarray<Number, nb::shape<axes...>, nb::c_contig, nb::device::cpu>;

// Read: a copy, where it is laid out otherwise or is of other numbers. Filled: as it is, or it is refused.
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
        Whole found;  // never a copy, which would be filled in its place
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

// The optics of a camera, and what they need to live.
class OpticsGiven {
  public:
    explicit OpticsGiven(Tuple given)
        : lens_(given[0]),
          kind_(nb::cast<std::string>(given[1])),
          form_(array<Read<N>>(given[2], "form")),
          unit_(nb::cast<double>(given[4])) {
        const Read<N> own = array<Read<N>>(given[3], "intrinsics");
        require(own.size() >= 5, "intrinsics: phi, aspect, cx, cy, coefficients and skew are needed");
        intrinsics.assign(own.data(), own.data() + own.size());
    }

    std::vector<double> intrinsics;

    Optics make() const {
        const int count = whole(intrinsics.size());
        const Making from{{form_.data(), whole(form_.size())}, {intrinsics.data(), count - 1}, unit_};
        std::unique_ptr<Lens> lens = make_lens(kind_, from);
        if (!lens) {
            nb::ndarray<nb::numpy, const double, nb::ndim<1>> own(intrinsics.data() + 4, {intrinsics.size() - 5});
            lens = std::make_unique<PythonLens>(lens_.attr("with_scaled")(own.cast(nb::rv_policy::copy), unit_), from);
        }
        return {std::move(lens), intrinsics.data(), count};
    }

  private:
    nb::object lens_;
    std::string kind_;
    Read<N> form_;
    double unit_;
};

// Groups of rows, each from bounds[g] to bounds[g + 1].
inline void check_bounds(const Array<const int64_t, N>& bounds, int64_t first, int64_t last, size_t rows) {
    require(first >= 0 && last < static_cast<int64_t>(bounds.size()), "there are fewer sights than that");
    for (int64_t v = first; v < last; ++v) require(bounds.data()[v] <= bounds.data()[v + 1], "bounds: must not fall");
    require(first >= last || (bounds.data()[first] >= 0 && bounds.data()[last] <= static_cast<int64_t>(rows)),
            "bounds: there are fewer observations than that");
}

// The sights from `first` to `last` of some columns, and what these need to live.
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

class PointsGiven : public Columns<BUILT> {
  public:
    PointsGiven(Tuple given, int64_t first, int64_t last, int structure)
        : Columns(given[0], given[2], given[3], given[4], first, last, structure),
          places_(array<Read<N, 3>>(given[1], "places")),
          bends_(array<Read<N, BUILT - 2>>(given[5], "bends")) {
        require(places_.shape(0) == count(), "points: places are as many as pixels");
        require(slots.size() == 0 || slots.shape(0) == count(), "points: slots are as many as pixels, or none");
        require(slots.size() == 0 || bends_.shape(0) == count(), "points: slots need their bends");
    }

    Points view() const {
        return {bounds.data(), places_.data(), pixels.data(), weights.data(), slots_or_null(), bends_.data()};
    }
    bool has_bends() const { return bends_.shape(0) == count(); }

  private:
    Read<N, 3> places_;
    Read<N, BUILT - 2> bends_;
};

class CurvesGiven : public Columns<ON_TRACK> {
  public:
    CurvesGiven(Tuple given, int64_t first, int64_t last, int structure)
        : Columns(given[0], given[4], given[5], given[7], first, last, structure),
          tracks_(array<Read<N, 3, 3>>(given[1], "tracks")),
          is_arc_(array<Array<const bool, N>>(given[2], "is_arc")),
          track_(array<Array<const int32_t, N>>(given[3], "track")),
          feet_(array<Filled<N>>(given[6], "feet")) {
        const size_t tracks = tracks_.shape(0);
        require(feet_.size() == count() && track_.size() == count(), "curves: feet and track are as many as pixels");
        require(is_arc_.size() == tracks, "curves: is_arc is as many as tracks");
        require(slots.size() == 0 || slots.shape(0) == tracks, "curves: slots are as many as tracks, or none");
        for (int64_t k = first < last ? bounds.data()[first] : 0; first < last && k < bounds.data()[last]; ++k)
            require(track_.data()[k] >= 0 && track_.data()[k] < whole(tracks),
                    "curves: there are fewer tracks than that");
    }

    Curves view() const {
        return {bounds.data(), tracks_.data(), is_arc_.data(), track_.data(),
                pixels.data(), weights.data(), feet_.data(),   slots_or_null()};
    }

  private:
    Read<N, 3, 3> tracks_;
    Array<const bool, N> is_arc_;
    Array<const int32_t, N> track_;
    Filled<N> feet_;
};

inline Loss loss_given(Tuple given) {
    const int code = nb::cast<int>(given[0]);
    require(code >= 0 && code <= static_cast<int>(LossCode::tukey), "loss: there is no such code");
    return {static_cast<LossCode>(code), nb::cast<double>(given[1])};
}

// What the solve's kernels take of sights from `first` to `last`.
class Seen {
  public:
    Seen(int64_t first, int64_t last, Tuple optics, Tuple unknowns, Tuple points, Tuple curves, Tuple loss)
        : optics(optics),
          loss(loss_given(loss)),
          free_(array<Array<const int64_t, N>>(unknowns[0], "unknowns.free")),
          unknowns{free_.data(), whole(free_.size()), nb::cast<int>(unknowns[1])},
          points_(points, first, last, this->unknowns.structure),
          curves_(curves, first, last, this->unknowns.structure),
          points(points_.view()),
          curves(curves_.view()) {
        for (size_t k = 0; k < free_.size(); ++k)
            require(free_.data()[k] >= 0 && free_.data()[k] < static_cast<int64_t>(this->optics.intrinsics.size()),
                    "unknowns: there is no such intrinsic");
        require(this->unknowns.structure >= 0, "unknowns: fewer structure numbers than none");
        require(points_.weights.size() == points_.count() && curves_.weights.size() == curves_.count(),
                "weights are needed");
    }

    OpticsGiven optics;
    const Loss loss;

  private:
    Array<const int64_t, N> free_;

  public:
    const Unknowns unknowns;

  private:
    const PointsGiven points_;
    const CurvesGiven curves_;

  public:
    const Points points;
    const Curves curves;
};

}  // namespace ceres_cal
