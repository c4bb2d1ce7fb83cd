"""Branches of limit cycles over a parameter: folds, changes of mode, grazings, tori beside them."""
