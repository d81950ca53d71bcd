from ceres_cal.start.same_labels import Labels as Labels
from ceres_cal.start.same_labels import open_words as open_words
from ceres_cal.start.same_labels import symmetries as symmetries
from ceres_cal.start.same_labels import with_same_labels as with_same_labels
