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

template <class Number, size_t dimensions>
using Array = nb::ndarray<Number, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;

// An array to be read is copied where it is laid out otherwise; one to be filled must be right as it is.
template <class Number, size_t dimensions>
Array<Number, dimensions> array(nb::handle given, const char* name) {
    Array<Number, dimensions> found;
    if (!nb::try_cast(given, found, std::is_const_v<Number>)) {
        const std::string kind =
            std::is_same_v<std::remove_const_t<Number>, double> ? "numbers" : "whole numbers or marks";
        throw nb::type_error((std::string(name) + ": an array of " + kind + " with " + std::to_string(dimensions) +
                              " dimensions" + (std::is_const_v<Number> ? "" : ", contiguous and writeable") +
                              " is needed")
                                 .c_str());
    }
    return found;
}

inline void require(bool good, const char* what) {
    if (!good) throw nb::value_error(what);
}

template <class A>
bool has_shape(const A& array, std::initializer_list<size_t> shape) {
    size_t axis = 0;
    for (const size_t length : shape)
        if (array.shape(axis++) != length) return false;
    return true;
}

inline int whole(size_t number) { return static_cast<int>(number); }

// The optics of a camera, and what they need to live.
class OpticsGiven {
  public:
    // intrinsics: others than the tuple's, or none.
    explicit OpticsGiven(const nb::tuple& given)
        : lens_(given[0]),
          kind_(nb::cast<std::string>(given[1])),
          form_(array<const double, 1>(given[2], "form")),
          given_(array<const double, 1>(given[3], "intrinsics")),
          unit_(nb::cast<double>(given[4])) {
        require(given_.shape(0) >= 5, "intrinsics: phi, aspect, cx, cy, coefficients and skew are needed");
        intrinsics_.assign(given_.data(), given_.data() + given_.shape(0));
    }

    std::vector<double>& intrinsics() { return intrinsics_; }

    Optics make() {
        const int count = whole(intrinsics_.size());
        const Making from{{form_.data(), whole(form_.shape(0))}, {intrinsics_.data(), count - 1}, unit_};
        std::unique_ptr<Lens> lens = make_lens(kind_, from);
        if (!lens) {
            const Array<const double, 1> coefficients(intrinsics_.data() + 4, {intrinsics_.size() - 5});
            const nb::object own =
                nb::ndarray<nb::numpy, const double, nb::ndim<1>>(coefficients).cast(nb::rv_policy::copy);
            lens = std::make_unique<PythonLens>(lens_.attr("with_scaled")(own, unit_), from);
        }
        return {std::move(lens), intrinsics_.data(), count};
    }

  private:
    nb::object lens_;
    std::string kind_;
    Array<const double, 1> form_, given_;
    double unit_;
    std::vector<double> intrinsics_;
};

// Sights from `first` to `last` of some columns: their bounds, checked.
inline void check_bounds(const Array<const int64_t, 1>& bounds, int64_t first, int64_t last, size_t rows) {
    require(first >= 0 && last < static_cast<int64_t>(bounds.shape(0)), "there are fewer sights than that");
    for (int64_t v = first; v < last; ++v) require(bounds.data()[v] <= bounds.data()[v + 1], "bounds: must not fall");
    require(first >= last || (bounds.data()[first] >= 0 && bounds.data()[last] <= static_cast<int64_t>(rows)),
            "bounds: there are fewer observations than that");
}

class PointsGiven {
  public:
    explicit PointsGiven(const nb::tuple& given)
        : bounds_(array<const int64_t, 1>(given[0], "points.bounds")),
          places_(array<const double, 2>(given[1], "points.places")),
          pixels_(array<const double, 2>(given[2], "points.pixels")),
          weights_(array<const double, 1>(given[3], "points.weights")),
          slots_(array<const int32_t, 2>(given[4], "points.slots")),
          bends_(array<const double, 2>(given[5], "points.bends")) {
        const size_t n = pixels_.shape(0);
        require(has_shape(places_, {n, 3}) && has_shape(pixels_, {n, 2}), "points: places are (N, 3), pixels (N, 2)");
        require(weights_.shape(0) == n || weights_.shape(0) == 0, "points: weights are (N,) or none");
        require(slots_.shape(0) == 0 || has_shape(slots_, {n, BUILT}), "points: slots are (N, 7) or none");
        require(bends_.shape(0) == 0 || has_shape(bends_, {n, BUILT - 2}), "points: bends are (N, 5) or none");
        require(slots_.shape(0) == 0 || bends_.shape(0) == n, "points: slots need their bends");
    }

    // Of sights from `first` to `last`; slots lie below `structure`.
    Points view(int64_t first, int64_t last, int structure) const {
        check_bounds(bounds_, first, last, pixels_.shape(0));
        const bool moved = slots_.shape(0) > 0;
        if (moved) check_slots(slots_, structure);
        return {bounds_.data(), places_.data(), pixels_.data(), weights_.data(), moved ? slots_.data() : nullptr,
                bends_.data()};
    }

    void need_weights() const { require(weights_.shape(0) == pixels_.shape(0), "points: weights are needed"); }
    void need_bends() const { require(bends_.shape(0) == pixels_.shape(0), "points: bends are needed"); }
    size_t count() const { return pixels_.shape(0); }

    static void check_slots(const Array<const int32_t, 2>& slots, int structure) {
        const size_t size = slots.shape(0) * slots.shape(1);
        int32_t largest = -1;
        for (size_t k = 0; k < size; ++k) largest = std::max(largest, slots.data()[k]);
        require(largest < structure, "slots: there are fewer structure numbers than that");
    }

  private:
    Array<const int64_t, 1> bounds_;
    Array<const double, 2> places_, pixels_;
    Array<const double, 1> weights_;
    Array<const int32_t, 2> slots_;
    Array<const double, 2> bends_;
};

class CurvesGiven {
  public:
    explicit CurvesGiven(const nb::tuple& given)
        : bounds_(array<const int64_t, 1>(given[0], "curves.bounds")),
          tracks_(array<const double, 3>(given[1], "curves.tracks")),
          is_arc_(array<const bool, 1>(given[2], "curves.is_arc")),
          track_(array<const int32_t, 1>(given[3], "curves.track")),
          pixels_(array<const double, 2>(given[4], "curves.pixels")),
          weights_(array<const double, 1>(given[5], "curves.weights")),
          feet_(array<double, 1>(given[6], "curves.feet")),
          slots_(array<const int32_t, 2>(given[7], "curves.slots")) {
        const size_t n = pixels_.shape(0), tracks = tracks_.shape(0);
        require(has_shape(pixels_, {n, 2}) && feet_.shape(0) == n && track_.shape(0) == n,
                "curves: pixels are (M, 2), feet and track (M,)");
        require(has_shape(tracks_, {tracks, 3, 3}) && is_arc_.shape(0) == tracks,
                "curves: tracks are (T, 3, 3), is_arc (T,)");
        require(weights_.shape(0) == n || weights_.shape(0) == 0, "curves: weights are (M,) or none");
        require(slots_.shape(0) == 0 || has_shape(slots_, {tracks, ON_TRACK}), "curves: slots are (T, 3) or none");
    }

    Curves view(int64_t first, int64_t last, int structure) const {
        check_bounds(bounds_, first, last, pixels_.shape(0));
        if (slots_.shape(0) > 0) PointsGiven::check_slots(slots_, structure);
        const int64_t start = first < last ? bounds_.data()[first] : 0, end = first < last ? bounds_.data()[last] : 0;
        const int32_t tracks = static_cast<int32_t>(tracks_.shape(0));
        bool good = true;
        for (int64_t k = start; k < end; ++k) good &= track_.data()[k] >= 0 && track_.data()[k] < tracks;
        require(good, "curves: there are fewer tracks than that");
        return {bounds_.data(), tracks_.data(),  is_arc_.data(), track_.data(),
                pixels_.data(), weights_.data(), feet_.data(),   slots_.shape(0) > 0 ? slots_.data() : nullptr};
    }

    void need_weights() const { require(weights_.shape(0) == pixels_.shape(0), "curves: weights are needed"); }
    size_t count() const { return pixels_.shape(0); }

  private:
    Array<const int64_t, 1> bounds_;
    Array<const double, 3> tracks_;
    Array<const bool, 1> is_arc_;
    Array<const int32_t, 1> track_;
    Array<const double, 2> pixels_;
    Array<const double, 1> weights_;
    Array<double, 1> feet_;
    Array<const int32_t, 2> slots_;
};

inline Loss loss_given(const nb::tuple& given) {
    const int code = nb::cast<int>(given[0]);
    require(code >= 0 && code <= static_cast<int>(LossCode::tukey), "loss: there is no such code");
    return {static_cast<LossCode>(code), nb::cast<double>(given[1])};
}

class UnknownsGiven {
  public:
    UnknownsGiven(const nb::tuple& given, size_t intrinsics)
        : free_(array<const int64_t, 1>(given[0], "unknowns.free")),
          view{free_.data(), whole(free_.shape(0)), nb::cast<int>(given[1])} {
        for (int k = 0; k < view.count; ++k)
            require(view.free[k] >= 0 && view.free[k] < static_cast<int64_t>(intrinsics),
                    "unknowns: there is no such intrinsic");
        require(view.structure >= 0, "unknowns: fewer structure numbers than none");
    }

  private:
    Array<const int64_t, 1> free_;

  public:
    const Unknowns view;
};

}  // namespace ceres_cal
