"""The paper's figures and tables, computed and compared with what it prints: what `fj.reproduce` runs.

Written as a user would write it: nothing of fivjax is used here but its public names. Read first: `report`, which lists all
figures; `scenes`, the paper's parameters; `findings`, a printed number beside the computed one. Each other module makes some
of the figures.
"""
