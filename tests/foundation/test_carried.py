"""What a loop starts from may depend on what it is given, without another value and with fewer transformations of its body."""

import jax
import jax.numpy as jnp
import numpy as np

from fivjax.foundation.carried import depending_on


def test_values_and_types_stay_whatever_is_given():
    begin = {
        "real": jnp.asarray([1.5, np.nan]),
        "count": jnp.asarray(3, jnp.int32),
        "flag": jnp.asarray(True),
        "none": None,
    }
    for given in (jnp.asarray(np.nan), jnp.asarray([np.inf, 1.0]), (), jnp.zeros((0, 2)), ("text", 3)):
        found = depending_on(given, begin)
        assert jax.tree.structure(found) == jax.tree.structure(begin)
        for old, new in zip(jax.tree.leaves(begin), jax.tree.leaves(found), strict=True):
            assert old.dtype == new.dtype
            np.testing.assert_array_equal(old, new)


def test_no_derivative_is_added_even_of_what_is_not_finite():
    value, slope = jax.jvp(
        lambda x: depending_on(jnp.log(x), jnp.asarray(2.0)), (jnp.asarray(0.0),), (jnp.asarray(1.0),)
    )
    assert (float(value), float(slope)) == (2.0, 0.0)


def test_the_body_is_transformed_fewer_times():
    """Rejects what JAX, or a change here, would make useless: a chain of numbers, each of which depends on the one before."""

    def transformed(prepared):
        count = []

        @jax.custom_batching.custom_vmap
        def counted(x):
            return 2 * x

        @counted.def_vmap
        def _(size, batched, x):
            del size
            count.append(1)
            return 2 * x, batched[0]

        def of_one(x):
            begin = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
            begin = depending_on(x, begin) if prepared else begin
            _, total, _ = jax.lax.while_loop(
                lambda carry: carry[2] < 10,
                lambda carry: (carry[0] + counted(x), carry[0] + carry[1], carry[2] + 1),
                begin,
            )
            return total

        found = jax.vmap(of_one)(jnp.arange(3.0))
        np.testing.assert_allclose(found, 2 * 45 * np.arange(3.0))
        return len(count)

    assert transformed(True) < transformed(False)
