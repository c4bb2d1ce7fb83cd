"""Tori."""


def torus_of(scene, stepper, point):
    return None
