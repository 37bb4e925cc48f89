"""A street whose second image is too bright, for tests of per-scene optimisation."""

import numpy as np
from reconstruct_street import Street

from nurec_sim.reconstruct import LiftSettings, ViewSettings
from nurec_sim.render import CpuRenderer
from nurec_sim.types import SensorRequest

SMALL = LiftSettings(sky_px=32, views=ViewSettings(levels=32))
CROSSING = {"moving": ((4.0, 1.8, 1.5), np.column_stack([np.linspace(12, 16, 4), np.full(4, 2.2)]))}


class Flicker(Street):
    """A street whose second image is taken 20 % too bright."""

    def image(self, camera_id, index):
        image = super().image(camera_id, index)
        return np.clip(image * (1.2 if index == 1 else 1.0), 0, 255).astype(np.uint8)


def image_of(scene, clip, name, index):
    t_us = int(clip.t_us[index])
    request = SensorRequest(scene.id, clip.rig.cameras[name], t_us, t_us + 1, clip.world_from_camera(name, index))
    return CpuRenderer(scene, threads=1).render_camera(request, ("rgb",)).rgb
