// The lenses that are compiled.
#pragma once

#include <memory>
#include <string_view>

#include "brown.hpp"
#include "kannala_brandt.hpp"
#include "radial.hpp"
#include "spline.hpp"

namespace ceres_cal {

// Null for one that Python has alone.
inline std::unique_ptr<Lens> make_lens(std::string_view kind, const Making& from) {
    if (kind == "radial") return std::make_unique<Radial>(from);
    if (kind == "brown") return std::make_unique<Brown>(from);
    if (kind == "kannala-brandt") return std::make_unique<KannalaBrandt>(from);
    if (kind == "spline") return std::make_unique<Spline>(from);
    return nullptr;
}

}  // namespace ceres_cal
