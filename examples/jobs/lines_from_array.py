"""Painted lines from NumPy arrays, and the height by a tape measure, to a posed camera."""

import ceres_cal as cc

field, sample = cc.ssl_field("B"), cc.Observations.load("data/ssl_field/observations.json").curves
lines = {name: sample.pixels[sample.feature == n] for n, name in enumerate(field.curves)}  # each (N, 2) px
lines = {name: pixels for name, pixels in lines.items() if len(pixels)}
seen = cc.Observations.from_curves(lines, field, (1280, 960), sigma_px=0.3)
height = cc.Prior("station", "camera", "height_m", (4.02,), (0.01,))
calibration = cc.calibrate(seen, cc.Options(lens="radial", powers=(2, 3), priors=(height,)))
print(calibration.station(), calibration.uncertainty.map_sd_mm().worst_mm)
