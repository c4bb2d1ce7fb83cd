"""The paper's figures and tables, computed and compared with what it prints: what `fj.reproduce` runs.

Read first: `report`, which makes them all; `scenes`, the paper's parameters; `findings`, a printed number beside the
computed one. Each other module makes some of the figures.
"""
