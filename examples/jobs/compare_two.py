"""Where two calibrations of one camera differ on the field, and whether their uncertainties explain it."""

import sys

import ceres_cal as cc

first, second = (cc.Calibration.load(path) for path in sys.argv[1:3])
for name, one in cc.compare(first, second, height_m=0.15).items():
    assert one.change is not None
    print(f"{name}: {one.change.maps[0].worst_mm:.2f} mm at most, explained: {one.holds}")
