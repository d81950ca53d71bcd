"""After a move: check one photograph, and bring the camera back where it no longer holds."""

import sys

import ceres_cal as cc

before = cc.Calibration.load(sys.argv[1])
if not cc.check(before, sys.argv[2]).holds:
    now = cc.refit(before, sys.argv[2])
    now.save(sys.argv[1])
    print(f"moved, {now.uncertainty.map_sd_mm().worst_mm:.2g} mm at worst now")
