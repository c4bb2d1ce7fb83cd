"""A tree of arrays as one array: nothing is lost on the way, and rows are compacted in place."""

import numpy as np

from fivjax.foundation.flattened import MOVED_AT_ONCE, flatten


def tree_of(rows: int):
    rng = np.random.default_rng(1)
    return {
        "real": rng.normal(size=(rows, 2, 3)),
        "complex": rng.normal(size=(rows, 2)) + 1j * rng.normal(size=(rows, 2)),
        "whole": rng.integers(-5, 5, rows).astype(np.int32),
        "truth": rng.random(rows) < 0.5,
    }


def test_a_tree_comes_back_as_it_was():
    tree = tree_of(7)
    back = flatten(tree).tree
    for name, leaf in tree.items():
        np.testing.assert_array_equal(back[name], leaf)
        assert back[name].dtype == leaf.dtype


def test_what_is_written_to_a_real_leaf_is_written_to_the_array():
    numbers = flatten(tree_of(7))
    numbers.tree["real"][3, 1, 2] = 42.0
    assert numbers.tree["real"][3, 1, 2] == 42.0


def test_rows_are_compacted_in_place():
    """More rows than are moved at a time, so that one move writes where the next one reads."""
    rows = 3 * MOVED_AT_ONCE
    numbers = flatten(tree_of(rows))
    before = numbers.numbers.copy()
    kept = np.flatnonzero(np.random.default_rng(2).random(rows) < 0.7)
    kept_rows = numbers.compacted(kept)
    np.testing.assert_array_equal(kept_rows.numbers, before[kept])
    assert np.shares_memory(kept_rows.numbers, numbers.numbers)
    assert numbers.compacted(np.arange(rows)) is numbers
