"""Where the time of a later `fivjax map` goes, from the start of the process: imports, tracing, lowering, the cache, the map.

    python tests/measure_start.py [parts] [export]

Wall time by JAX's own events (they nest: tracing inside tracing is counted in both). Run it twice with a compilation cache
(`JAX_COMPILATION_CACHE_DIR`): the second run is the later start.
"""

import time

BEGIN, CORES = time.perf_counter(), time.process_time()

import collections  # noqa: E402
import sys  # noqa: E402

import jax  # noqa: E402

import fivjax as fj  # noqa: E402


def parts() -> None:
    """Where the time of the first and second map of a process goes."""
    seconds, counts = collections.Counter(), collections.Counter()

    def heard(event: str, duration: float, **_) -> None:
        name = event.rpartition("/")[2]
        seconds[name] += duration
        counts[name] += 1

    jax.monitoring.register_event_duration_secs_listener(heard)
    import numpy as np

    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    axes = {"mu": np.linspace(0.05, 0.228, 64), "p": np.linspace(1.0, 4.0, 64)}
    print(f"imports and scene: {time.perf_counter() - BEGIN:.1f} s ({time.process_time() - CORES:.1f} s of cores)")
    for call in ("first map", "second map"):
        seconds.clear()
        counts.clear()
        begin, cores = time.perf_counter(), time.process_time()
        fj.bistability_map(scene, progress=False, **axes)
        print(f"{call}: {time.perf_counter() - begin:.1f} s ({time.process_time() - cores:.1f} s of cores)")
        for name, total in seconds.most_common():
            print(f"    {name}: {total:.1f} s in {counts[name]}")


def exported() -> None:
    """What `jax.export` would spare: two of a map's programs traced and exported, and called from what was kept (the second
    time with the compilation cache). Needs the package flatbuffers.
    """
    import equinox as eqx
    import numpy as np
    from jax import export

    from fivjax.foundation.compiling import _options
    from fivjax.maps import rounds, section

    met = {}
    for module, name in ((rounds, "_follow_block"), (section, "moved_in_windows")):
        function = getattr(module, name)

        def noting(*given, function=function, name=name):
            met.setdefault(name, (function, given))
            return function(*given)

        setattr(module, name, noting)
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    fj.bistability_map(scene, progress=False, mu=[0.2], p=[1.1, 3.0])
    with jax.enable_x64(True):
        for name, (function, given) in met.items():
            arrays, rest = eqx.partition(given, eqx.is_array)
            leaves, tree = jax.tree.flatten(arrays)

            def flat(*leaves, function=function, tree=tree, rest=rest):
                return function.__wrapped__(*eqx.combine(jax.tree.unflatten(tree, leaves), rest)).numbers

            begin = time.perf_counter()
            kept = export.export(jax.jit(flat))(*leaves).serialize()
            print(f"{name}: traced and exported in {time.perf_counter() - begin:.1f} s, {len(kept) / 1e6:.2f} MB")
            for which in ("first", "later"):
                jax.clear_caches()
                begin = time.perf_counter()
                again = jax.jit(export.deserialize(kept).call, compiler_options=_options())
                numbers = np.asarray(again(*leaves))
                print(f"    {which} call from what was kept: {time.perf_counter() - begin:.1f} s", flush=True)
            print("    same bits:", np.array_equal(numbers, np.asarray(function(*given).numbers), equal_nan=True))


if __name__ == "__main__":
    studies = {"parts": parts, "export": exported}
    for word in sys.argv[1:] or ["parts"]:
        studies[word]()
