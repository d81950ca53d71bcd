from ceres_cal.start import same_labels as same_labels
