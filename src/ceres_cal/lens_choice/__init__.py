"""Which lens the data ask for (design, section 4)."""

from ceres_cal.lens_choice.choice import Chosen, choose_lens
from ceres_cal.lens_choice.forms import PAPER, any_lens, candidates, coefficients_of, label_of, papers, size_of
from ceres_cal.lens_choice.rule import decide, surprise

__all__ = [
    "PAPER",
    "Chosen",
    "any_lens",
    "candidates",
    "choose_lens",
    "coefficients_of",
    "decide",
    "label_of",
    "papers",
    "size_of",
    "surprise",
]
