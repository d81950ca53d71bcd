from ceres_cal.posterior.uncertainty import field_grid as field_grid
