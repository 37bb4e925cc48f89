"""All materials of a town: textures, shininess and emission by style and weather."""

from __future__ import annotations

import numpy as np

from nurec_sim.world.assets import textures_facades, textures_ground, textures_plants, textures_signs, textures_vehicles
from nurec_sim.world.model.builder import SpecBuilder
from nurec_sim.world.model.sky import Sky
from nurec_sim.world.model.weather import illumination
from nurec_sim.world.plan.town import SIGNS, TownPlan

WET_DARKER = 0.45
"""Darkening of a wet road."""
LAMPS_ON = 0.7
"""Lamps and rooms are lit above this ``dusk``."""


def add_materials(builder: SpecBuilder, plan: TownPlan, sky: Sky) -> None:
    """All materials except paint and clothes of actors; each group has its own random stream."""
    _ground(builder, plan, sky)
    _facades(builder, plan)
    _plants(builder, plan)
    _furniture(builder, plan)
    _vehicles(builder, plan)


def _stream(plan: TownPlan, number: int) -> np.random.Generator:
    return np.random.default_rng([plan.style.texture_seed, number])


def _ground(builder: SpecBuilder, plan: TownPlan, sky: Sky) -> None:
    rng, style, wet = _stream(plan, 1), plan.style, plan.weather.wetness
    dark, shine = 1 - WET_DARKER * wet, 0.05 + 0.75 * wet
    soaked = (dark, dark, dark * 1.02)
    paint = float(rng.uniform(205, 236))
    builder.material("asphalt", textures_ground.asphalt(rng, style.asphalt), soaked, shine)
    builder.material("paving", textures_ground.paving(rng, style.paving), tuple(0.85 * c + 0.15 for c in soaked), shine)
    builder.material("kerb", textures_ground.kerb(rng), tuple(0.85 * c + 0.15 for c in soaked), 0.5 * shine)
    builder.material("grass", textures_ground.grass(rng), (1 - 0.2 * wet,) * 3)
    builder.material("white", textures_ground.worn_paint(rng, (paint, paint, paint * 0.98)), shine=shine)
    builder.material("yellow", textures_ground.worn_paint(rng, (paint, paint * 0.74, 52)), shine=shine)
    builder.material("tracks", textures_ground.wheel_track(rng))
    builder.material("stains", textures_ground.stains(rng))
    builder.material("seams", textures_ground.seams(rng), shine=0.2)
    builder.material("manhole", textures_ground.manhole(rng), shine=0.3)
    if plan.weather.dusk > LAMPS_ON:
        builder.material("light_pool", textures_ground.light_pool(), glow=1.0)
    if wet > 0:
        # Puddles show a mean sky colour, as the classic renderer has no reflections of the scene.
        mirrored = 0.5 * (sky.horizon + np.asarray(sky.colours.zenith))
        builder.material("puddles", textures_ground.puddles(rng, tuple(mirrored)), glow=0.35)


def _facades(builder: SpecBuilder, plan: TownPlan) -> None:
    dusk = plan.weather.dusk
    lit = 0.03 + 0.37 * dusk
    # Emission adds `glow` to the light `level` on all of the facade; dividing unlit parts by 1 + glow / level brings
    # them back to the light of the surroundings.
    level = sum(illumination(plan.weather).ambient) / 3 + 0.06
    glow = 0.72 if dusk > LAMPS_ON else 0.0
    night = glow / level
    wanted = sorted({(house.family, house.facade) for house in plan.buildings})
    for family, variant in wanted:
        # A stream per facade, so that a facade does not depend on which others a town has.
        rng = np.random.default_rng([plan.style.texture_seed, 2, variant, *family.encode()])
        image = textures_facades.facade(rng, family, lit, night)
        builder.material(f"facade_{family}{variant}", image, shine=0.5 if family == "glass" else 0.04, glow=glow)
    rng = _stream(plan, 3)
    for i in range(2):
        builder.material(f"shop{i}", textures_facades.shopfront(rng, night), shine=0.1, glow=glow)
        builder.material(f"roof{i}", textures_facades.roof(rng))
    concrete = textures_ground.paving(rng, "concrete", 256)
    builder.material("concrete", concrete, (0.96, 0.95, 0.93))


def _plants(builder: SpecBuilder, plan: TownPlan) -> None:
    rng = _stream(plan, 4)
    for i, family in enumerate(plan.style.foliages):
        builder.material(f"plant{i}", textures_plants.plant(rng, family))
    builder.material("hedge", textures_plants.plant(rng, "broadleaf"))
    builder.material("forest", textures_plants.plant(rng, "broadleaf", 128), (0.56, 0.62, 0.68))


def _furniture(builder: SpecBuilder, plan: TownPlan) -> None:
    rng, dusk = _stream(plan, 5), plan.weather.dusk
    grey = float(rng.uniform(0.25, 0.5))
    builder.material("metal", colour=(grey, grey * 1.02, grey * 1.03), shine=0.35)
    builder.material("dark", colour=(0.085, 0.09, 0.10), shine=0.2)
    builder.material("wood", textures_plants.plant(rng, "broadleaf", 128)[-16:], (1.15, 0.95, 0.75))
    builder.material("pane", colour=(0.46, 0.54, 0.58), shine=0.8)
    builder.material("orange", colour=(0.88, 0.30, 0.06), shine=0.2)
    builder.material("white_plastic", colour=(0.88, 0.88, 0.86), shine=0.2, glow=0.05)
    for i, colour in enumerate(((0.62, 0.10, 0.08), (0.12, 0.26, 0.16), (0.30, 0.31, 0.33))):
        builder.material(f"plastic{i}", colour=colour, shine=0.25)
    for picture in SIGNS:
        builder.material(f"sign_{picture}", textures_signs.sign(rng, picture), glow=0.22 + 0.15 * dusk)
    for i in range(2):
        builder.material(f"billboard{i}", textures_signs.billboard(rng), glow=0.05 + 0.5 * dusk)
    builder.material("lamp", colour=(0.98, 0.90, 0.72), glow=1.0 if dusk > LAMPS_ON else 0.1)
    for name, colour in (("red", (0.98, 0.10, 0.06)), ("amber", (1.0, 0.62, 0.06)), ("green", (0.10, 0.92, 0.42))):
        builder.material(f"light_{name}", colour=colour, glow=0.9)
    builder.material("light_off", colour=(0.09, 0.09, 0.10), shine=0.4)


def _vehicles(builder: SpecBuilder, plan: TownPlan) -> None:
    rng, weather = _stream(plan, 6), plan.weather
    # Lamps are on in fog, rain and dusk.
    on = 1.0 if weather.dusk > LAMPS_ON or weather.preset in ("foggy", "wet") else 0.0
    builder.material("glass", textures_vehicles.window(rng), shine=0.9)
    builder.material("cycle", shine=0.6)
    builder.material("trim", colour=(0.075, 0.075, 0.08), shine=0.25)
    for i in range(3):
        builder.material(f"wheel{i}", textures_vehicles.wheel(rng), shine=0.25)
    builder.material("headlight", textures_vehicles.lamp(rng, (214, 220, 224)), shine=0.9, glow=0.05 + 0.95 * on)
    builder.material("taillight", textures_vehicles.lamp(rng, (196, 18, 20)), shine=0.7, glow=0.12 + 0.5 * on)
    for i in range(4):
        builder.material(f"plate{i}", textures_vehicles.plate(rng), glow=0.06)
        builder.material(f"cargo{i}", textures_vehicles.cargo_box(rng), shine=0.1)
