"""A file as a user writes it, for a type checker: `test_package.py` looks at it, nobody runs it."""

import numpy as np

import fivjax as fj

structure = fj.belt_oscillator(k1=100e3, k2=101e3, theta=0.01)
own = fj.Structure(np.eye(3), np.zeros((3, 3)), np.eye(3) * 1e3, [0.0, -1.0, 0.0], tangential=0, normal=2)
scene = fj.Scene(structure, fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))
m = fj.bistability_map(scene, mu=np.linspace(0.05, 0.228, 4), p=[1.0, 2.0])
print(m["verdict"].values, m.attrs["mu_crit"])
table = fj.critical_perturbation(scene, belt_speed=[0.5, 1, 1.5])
print(float(table["p_crit"][0]))
run = fj.simulate(scene, t1=2.0, energy=True)
assert run.energy is not None
print(run.energy.mechanical.max(), run.displacement[:, 0].mean(), run.outcome, run.meaning)
cycle = fj.limit_cycle(scene.replace(belt_speed=1.0))
print(cycle.period, cycle.multipliers, cycle.word[0].duration)
fj.save_figure(fj.plot.response(run), "r.png")
fj.save(run, "run.nc")
data = fj.read_recording("d.csv", "kick", offset=(0.0, 0.2))
fit = fj.calibrate(scene, data, free=["mu", "c1"], bounds={"mu": (0.05, 0.5)})
print(fit.values["mu"], fj.citation(), fj.__version__)
d = fj.derivatives(lambda r: r.displacement[-1, 0], scene, ["mu"])
print(d.value)
print(float(fj.cea.critical_friction(structure)), fj.cea.eigenvalues(structure, 0.2))
e = fj.Verdict(1).name, fj.Status.SLIDE
fj.plot.bistability(m).savefig("x.png")
c = fj.energy_per_cycle(run)["contact_work"].values
