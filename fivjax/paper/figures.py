"""Every figure and table of the paper by name, in the order of the paper."""

from collections.abc import Callable

from .belt_speeds import figure_15, figure_16, figure_17, figure_18, table_2
from .energy_flows import figure_11, figure_12, figure_13, figure_14
from .findings import Made
from .instabilities import figure_4, figure_5, figure_6, figure_7
from .kicks import figure_8, figure_9, figure_10
from .linear_theory import figure_2, figure_3, table_1
from .runs import Runs

FIGURES: dict[str, Callable[[Runs], Made]] = {
    "table1": table_1,
    "2": figure_2,
    "3": figure_3,
    "4": figure_4,
    "5": figure_5,
    "6": figure_6,
    "7": figure_7,
    "8": figure_8,
    "9": figure_9,
    "10": figure_10,
    "11": figure_11,
    "12": figure_12,
    "13": figure_13,
    "14": figure_14,
    "15": figure_15,
    "16": figure_16,
    "17": figure_17,
    "18": figure_18,
    "table2": table_2,
}
