// A lens that exists only in Python: its NumPy formulas are called once for each chunk.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <string>

#include "lens.hpp"

namespace ceres_cal {

namespace nb = nanobind;

// It is made, used and destroyed while its caller keeps the lens. Only the calls into Python hold Python's lock.
class PythonLens final : public Lens {
  public:
    // lens: `scene.lens.Lens` with the coefficients of the intrinsics.
    PythonLens(nb::object lens, const Making& from)
        : Lens(from), lens_(std::move(lens)), coefficients_(from.intrinsics.count - 4) {}

    bool distort(int n, const Rays& rays, Image& image) override {
        const nb::gil_scoped_acquire lock;
        count_ = n, rays_ = &rays;
        const Found found = ask("slopes_by_ray", 4, nb::make_tuple());
        bool good = true;
        for (int i = 0; i < n; ++i) {
            const double* own = found.data() + 8 * i;
            for (int k = 0; k < 8; ++k) good &= own[k] - own[k] == 0.0;
            image.x[i] = own[0], image.xx[i] = own[1], image.xy[i] = own[2], image.xz[i] = own[3];
            image.y[i] = own[4], image.yx[i] = own[5], image.yy[i] = own[6], image.yz[i] = own[7];
        }
        return good;
    }

    void differentiate(const Rows& rows) override {
        const nb::gil_scoped_acquire lock;
        const Found found = ask("slopes_by_number", 1 + coefficients_, nb::make_tuple(unit));
        for (int k = 0; k <= coefficients_; ++k) {
            double* row = rows.show(k == 0 ? 0 : 3 + k);
            for (int i = 0; i < count_; ++i) {
                const double* own = found.data() + 2 * (1 + coefficients_) * i + k;
                row[i] = own[0], row[rows.n + i] = aspect * own[1 + coefficients_];
            }
        }
    }

  private:
    using Found = nb::ndarray<const double, nb::shape<-1, 2, -1>, nb::c_contig, nb::device::cpu>;

    // Returns lens.method(rays, phi, *more), (n, 2, columns).
    Found ask(const char* method, int columns, const nb::tuple& more) const {
        nb::ndarray<nb::numpy, const double, nb::ndim<2>> rays(rays_, {static_cast<size_t>(count_), 3}, nb::handle(),
                                                               {1, CHUNK});
        const nb::object answer = lens_.attr(method)(rays.cast(nb::rv_policy::copy), phi, *more);
        Found found;
        if (!nb::try_cast(answer, found) || found.shape(0) != static_cast<size_t>(count_) ||
            found.shape(2) != static_cast<size_t>(columns))
            throw nb::type_error((std::string("a lens's ") + method + " answers with another shape").c_str());
        return found;
    }

    nb::object lens_;
    int coefficients_, count_ = 0;
    const Rays* rays_ = nullptr;
};

}  // namespace ceres_cal
