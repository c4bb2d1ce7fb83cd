"""Results on disk: whole or absent, opened again as they were, with the scene and the settings that made them."""

import json
import os
import socket

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from jaxtyping import Array, Float

import fivjax as fj
from fivjax.foundation import whole_files
from fivjax.io import files
from fivjax.io.datasets import labelled
from fivjax.model import own_structures
from fivjax.model.friction import AbstractFriction
from fivjax.model.scene import IMPACT_LAWS
from tests.helpers.refusing import refused


@pytest.fixture(scope="module")
def run() -> fj.Trajectory:
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))
    return fj.simulate(scene, 0.05, 1e-3)


def same(one: fj.Scene, other: fj.Scene) -> bool:
    """Whether two scenes are the same to the last bit, by everything that a scene consists of."""
    return bool(eqx.tree_equal(one, other))


def empty(scene: fj.Scene) -> xr.Dataset:
    """A dataset that holds nothing but its provenance."""
    from fivjax.io.datasets import labelled

    return labelled(xr.Dataset(), scene)


def test_a_trajectory_is_saved_and_opened(run, tmp_path):
    """What is opened is the dataset that the trajectory makes, bit for bit, and a trajectory again where one is wanted."""
    path = fj.save(run, tmp_path / "run.nc")
    found = fj.open(path)
    xr.testing.assert_identical(found.drop_attrs(deep=False), run.to_dataset().drop_attrs(deep=False))
    again = fj.Trajectory.from_dataset(found)
    np.testing.assert_array_equal(again.velocity, run.velocity)
    assert same(again.scene, run.scene) and again.meaning == run.meaning and again.settings == run.settings
    assert found.fivjax.plot().axes


def test_a_trajectory_says_how_it_was_computed(run):
    """Without them, two saved runs that differ in method or step could not be told apart."""
    said = json.loads(run.to_dataset().attrs["settings"])
    assert said["method"].startswith("EventExact(") and said["dt_save"] == 1e-3 and said["t1"] == 0.05
    assert said["start"] == "sliding equilibrium"
    other = fj.simulate(run.scene, 0.05, 1e-3, fj.WhereSwitched(diffrax.Tsit5(), dt=1e-4), y0=np.zeros(6))
    said = json.loads(other.to_dataset().attrs["settings"])
    assert said["method"] == "WhereSwitched(Tsit5, dt=0.0001)" and said["dt"] == 1e-4
    assert said["start"] == "given by y0"


MATRICES = np.diag([1.0, 2.0, 0.1]), np.diag([0.1, 0.2, 0.3]), np.diag([1e5 / 3, 1e5, 1e5])
STRUCTURES = {
    "belt oscillator": fj.belt_oscillator(k1=1e5 / 3, theta=0.1),
    "matrices": fj.Structure(*MATRICES, [0.0, 0.1, -1.0], tangential=1, normal=2),
}
PARTS = {
    "constant": (fj.Coulomb(0.1 + 0.2), fj.ConstantLoad(1 / 3)),
    "two coefficients": (fj.Coulomb(0.2, 0.3), fj.Pulse(100.0, 1.1, 0.07, 0.01)),
    "falling": (fj.ExponentialDecay(0.3, 0.2, 1 / 7), fj.Pulse()),
}


@pytest.mark.parametrize("structure", STRUCTURES.values(), ids=STRUCTURES)
@pytest.mark.parametrize("parts", PARTS.values(), ids=PARTS)
def test_a_scene_comes_back(structure, parts):
    """A scene rebuilt from a dataset is the same to the last bit, for each kind of structure, friction law, load and impact."""
    for law in IMPACT_LAWS:
        scene = fj.Scene(structure, parts[0], -0.7, parts[1], restitution=0.1, impact_law=law)
        assert same(fj.Scene.from_dataset(empty(scene)), scene)


def rig(power: float) -> fj.Structure:
    """One whose matrices are the same for k = 1, whatever the power."""

    def matrices(k):
        return MATRICES[0], MATRICES[1], k**power * jnp.asarray(MATRICES[2]), jnp.array([0.0, 0.0, -1.0])

    return fj.Structure.from_parameters(matrices, {"k": 1.0}, tangential=0, normal=2)


def test_a_structure_comes_back_with_its_own_contacts():
    """The same function and numbers made another one, later."""

    def matrices(k):
        return jnp.eye(4), 0.1 * jnp.eye(4), k * jnp.eye(4), jnp.array([0.0, -1.0, 0.0, -2.0])

    def scene(*pairs):
        contacts = [fj.ContactPoint(*pair) for pair in pairs]
        return fj.Scene(fj.Structure.from_parameters(matrices, {"k": 1.0}, contacts=contacts), fj.Coulomb(0.2), 1.0)

    first, second = scene((0, 1), (2, 3)), scene((2, 3), (0, 1))
    for one in (first, second):
        found = fj.Scene.from_dataset(empty(one))
        assert found.structure.places == one.structure.places and set(found.structure.parameters) == {"k"}


def test_a_structure_by_a_function_of_one_s_own_comes_back_in_the_process_that_has_it(monkeypatch):
    """By what the function computes, not by its name or by the matrices of one point. Elsewhere only names of parameters are
    lost; refusing would lose the scene.
    """
    scene = fj.Scene(rig(2.0), fj.Coulomb(0.2), 3.0)
    dataset, _ = empty(scene), rig(3.0)
    found = fj.Scene.from_dataset(dataset)
    assert float(found.replace(k=3.0).structure.stiffness[1, 1]) == 9e5
    monkeypatch.setattr(own_structures, "_MADE", {})
    _ = rig(3.0)
    found = fj.Scene.from_dataset(dataset)
    assert found.structure.parameters == {}
    for name in ("mass", "damping", "stiffness", "load_direction"):
        np.testing.assert_array_equal(getattr(found.structure, name), getattr(scene.structure, name))
    _ = rig(2.0)
    assert set(fj.Scene.from_dataset(dataset).structure.parameters) == {"k"}


class Steady(AbstractFriction):
    """A law of a user's own whose constructor takes its fields by name."""

    level: Float[Array, ""]
    constant = True

    @property
    def static(self):
        return self.level

    def __call__(self, slip_speed):
        return self.level

    def variation(self, slip_speed):
        return 0 * slip_speed, 0 * slip_speed


def test_a_law_of_ones_own_comes_back_where_it_is_defined():
    """Its class is looked up by name; where it is not defined, a sentence says so instead of another law being taken."""
    scene = fj.Scene(fj.belt_oscillator(), Steady(np.float64(0.25)), 3.0)
    dataset = empty(scene)
    assert isinstance(fj.Scene.from_dataset(dataset).friction, Steady)
    dataset.attrs["scene"] = dataset.attrs["scene"].replace('"Steady"', '"Elsewhere"')
    with refused(ValueError, "friction law", "`Elsewhere`", "Import or define"):
        fj.Scene.from_dataset(dataset)


def test_what_cannot_be_saved_or_opened_is_refused(tmp_path, monkeypatch):
    (tmp_path / "text.nc").write_text("not a dataset")
    with refused(ValueError, "text.nc", "NetCDF"):
        fj.open(tmp_path / "text.nc")
    with refused(ValueError, "none.nc", "does not exist"):
        fj.open(tmp_path / "none.nc")
    for read in (fj.open, fj.read_matrices, lambda path: fj.read_recording(path.with_suffix(".csv"))):
        with pytest.raises(FileNotFoundError, match="does not exist"):
            read(tmp_path / "none.nc")
    with refused(ValueError, "`path`", "NUL"):
        fj.open("a\0.nc")
    with refused(TypeError, "`result`", "3 (int)"):
        fj.save(3, tmp_path / "three.nc")
    with refused(ValueError, "`dataset`", "scene"):
        fj.Scene.from_dataset(xr.Dataset())
    assert [path.name for path in tmp_path.iterdir()] == ["text.nc"]
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.R_OK)
    with refused(ValueError, "text.nc", "protected against reading"):
        fj.open(tmp_path / "text.nc")


def test_nothing_on_disk_is_ever_half_written(run, tmp_path, monkeypatch):
    """A write that breaks off, at whatever call, leaves the earlier file whole and nothing beside it."""
    path = fj.save(run, tmp_path / "run.nc")
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    for name in ("fsync", "fchmod", "replace"):
        with monkeypatch.context() as broken:
            broken.setattr(files.os, name, full)
            with pytest.raises(OSError, match="No space left"):
                fj.save(run, path)
            with pytest.raises(OSError, match="No space left"):
                fj.save_figure(fj.plot.response(run), path, format="png")
        assert path.read_bytes() == before
        assert [found.name for found in tmp_path.iterdir()] == ["run.nc"]


def test_a_file_is_written_through_links_and_keeps_its_permissions(tmp_path):
    """As by any other program: a link stays a link, and what only its owner could read stays that owner's."""
    (tmp_path / "far").mkdir()
    files.save_text("old", tmp_path / "far" / "secret.md")
    (tmp_path / "far" / "secret.md").chmod(0o600)
    (tmp_path / "link.md").symlink_to("far/secret.md")
    (tmp_path / "new.md").symlink_to("far/new.md")
    for name in ("link.md", "new.md"):
        assert files.save_text("new", tmp_path / name) == tmp_path / name
        assert (tmp_path / name).is_symlink() and (tmp_path / name).read_text() == "new"
    assert (tmp_path / "far" / "secret.md").stat().st_mode & 0o777 == 0o600
    ordinary = tmp_path / "ordinary"
    ordinary.touch()
    assert (tmp_path / "far" / "new.md").stat().st_mode == ordinary.stat().st_mode
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "far",
        "link.md",
        "new.md",
        "new.md",
        "ordinary",
        "secret.md",
    ]


def test_what_is_no_file_is_never_replaced_by_one(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "null").symlink_to("/dev/null")
    (tmp_path / "round").symlink_to("round")
    (tmp_path / "nowhere").symlink_to("none/file.md")
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind(str(tmp_path / "socket"))
    before = {path.name: path.lstat() for path in tmp_path.iterdir()}
    for name, kind in {
        "fifo": "a FIFO",
        "socket": "a socket",
        "null": "a device",
        "round": "leads back to itself",
    }.items():
        with refused(ValueError, "Output path", name, kind, "give another"):
            files.save_text("text", tmp_path / name)
    with refused(ValueError, "Output folder", "none", "does not exist"):
        files.save_text("text", tmp_path / "nowhere")
    assert {path.name: path.lstat() for path in tmp_path.iterdir()} == before


def test_what_killed_savers_leave_is_removed_and_what_is_being_written_is_not(tmp_path):
    handle, living = whole_files._new_locked_file(tmp_path, 0o600)
    with whole_files.own_folder(tmp_path) as folder:
        (tmp_path / ".fivjax.file.part").write_text("left")
        (tmp_path / ".fivjax.folder.part").mkdir()
        (tmp_path / ".fivjax.folder.part" / "file").write_text("left")
        (tmp_path / ".hidden").write_text("of somebody else")
        files.save_text("text", tmp_path / "text.md")
        assert set(tmp_path.iterdir()) == {living, folder, tmp_path / ".hidden", tmp_path / "text.md"}
    os.close(handle)
    files.save_text("text", tmp_path / "text.md")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", "text.md"]


def test_a_scene_prints_its_values(run):
    """Types and shapes alone (`f64[]`) do not tell two scenes apart."""
    text = str(run.scene)
    for part in ("belt_oscillator(m1=0.53", "k2=101000", "Coulomb(mu=0.227)", "belt_speed=3", "p=1.2", '"coulomb"'):
        assert part in text
    assert "f64" not in text + str(fj.Structure(*MATRICES, [0, 0, -1]))
    assert "[0, 2, 0]" in str(fj.Structure(*MATRICES, [0, 0, -1]))
    # What is printed is the call that makes the scene.
    rebuilt = eval(text.replace("Scene(", "fj.Scene(", 1), {"fj": fj, **{name: getattr(fj, name) for name in dir(fj)}})
    assert same(rebuilt, run.scene)


@pytest.mark.parametrize(
    "value", [None, True, {"a": 1}, [1, "b"], [True], 10**30, "a\0b", b"a\0b", np.timedelta64(1, "s"), [[1, 2], [3]]]
)
def test_what_no_file_holds_is_refused_by_name(tmp_path, value):
    """Rejects what ended in an error of h5py's that names no attribute."""
    data = xr.Dataset({"v": ("x", np.ones(2), {"own": value})})
    with refused(TypeError, "`own`", "variable `v`"):
        fj.save(data, tmp_path / "own.nc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("attribute", [{"scale_factor": 2.0}, {"_FillValue": 1.0}, {"units": "s since 2000-01-01"}])
def test_what_would_be_read_as_other_values_is_refused(tmp_path, attribute):
    """Values came back doubled, as NaN, or not at all."""
    data = xr.Dataset({"v": ("x", np.ones(2), attribute)})
    with refused(ValueError, f"`{next(iter(attribute))}`", "variable `v`"):
        fj.save(data, tmp_path / "own.nc")
    assert list(tmp_path.iterdir()) == []


def test_a_parameter_of_a_structure_is_none_of_a_law_that_does_without(tmp_path):
    """`Coulomb` has an optional `mu_static`: a scene that comes back must not find it in the structure."""

    def matrices(mu_static):
        return jnp.eye(2), 0.1 * jnp.eye(2), jnp.diag(jnp.stack([mu_static, jnp.asarray(4.0)])), jnp.array([0.0, -1.0])

    structure = fj.Structure.from_parameters(matrices, {"mu_static": 1.0}, tangential=0, normal=1)
    scene = fj.Scene(structure, fj.Coulomb(0.2), 0.3, fj.ConstantLoad(1.0))
    again = fj.Scene.from_dataset(fj.simulate(scene, 0.1, 0.05).to_dataset())
    assert str(again.friction) == str(scene.friction)


def test_a_structure_comes_back_as_what_it_was_whatever_made_it():
    def matrices(k1, **others):
        mass, damping, stiffness, load = fj.belt_oscillator(k1=k1, **others).matrices
        return mass, damping, 2 * stiffness, load

    def build(**parameters):
        return fj.Structure.from_parameters(matrices, parameters, tangential=0, normal=2, builder=build)

    build.__name__ = "belt_oscillator"
    own = {name: float(value) for name, value in fj.belt_oscillator().parameters.items()}
    scene = fj.Scene(build(**own), fj.Coulomb(0.2), 1.0, fj.ConstantLoad(100.0))
    again = fj.Scene.from_dataset(fj.simulate(scene, 0.01, 1e-3).to_dataset())
    np.testing.assert_array_equal(again.structure.stiffness, scene.structure.stiffness)
    assert again.structure.coordinates == scene.structure.coordinates


def test_settings_may_be_single_numbers_of_numpy_and_jax(run):
    """They were refused as soon as all was computed."""
    found = labelled(xr.Dataset(), run.scene, t_max=np.float32(3), count=np.int64(2), step=jnp.asarray(0.5))
    assert json.loads(found.attrs["settings"]) == {"t_max": 3.0, "count": 2, "step": 0.5}


@pytest.mark.parametrize(
    ("value", "kept"),
    [
        (np.str_("b"), "b"),
        (np.array(["a", "b"]), ["a", "b"]),
        ([[1, 2], [3, 4]], [[1, 2], [3, 4]]),
        (1 + 2j, 1 + 2j),
        ([jnp.asarray(1.0), 2.0], [1.0, 2.0]),
        (range(3), [0, 1, 2]),
    ],
)
def test_what_a_file_holds_in_another_form_is_saved(tmp_path, value, kept):
    data = xr.Dataset({"v": ("x", np.ones(2))}, attrs={"own": value})
    found = fj.open(fj.save(data, tmp_path / "own.nc")).attrs["own"]
    assert np.asarray(found).tolist() == kept and data.attrs["own"] is value
