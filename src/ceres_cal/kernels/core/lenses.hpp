// The table of the lenses.
#pragma once

#include <memory>
#include <string_view>

#include "brown.hpp"
#include "kannala_brandt.hpp"
#include "radial.hpp"
#include "spline.hpp"

namespace ceres_cal {

template <class Kind>
std::unique_ptr<Lens> make(const Making& from) {
    return std::make_unique<Kind>(from);
}

struct Known {
    std::string_view kind;
    std::unique_ptr<Lens> (*make)(const Making&);
};

constexpr Known LENSES[] = {
    {"radial", make<Radial>},
    {"brown", make<Brown>},
    {"kannala-brandt", make<KannalaBrandt>},
    {"spline", make<Spline>},
};

// Null for one that Python has alone.
inline std::unique_ptr<Lens> make_lens(std::string_view kind, const Making& from) {
    for (const Known& known : LENSES)
        if (known.kind == kind) return known.make(from);
    return nullptr;
}

}  // namespace ceres_cal
