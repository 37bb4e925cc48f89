"""What cameras see of the car that carries them, so that it is not rebuilt as part of the street."""

from nurec_sim.reconstruct.ego_vehicle.images import find_ego_images

__all__ = ["find_ego_images"]
