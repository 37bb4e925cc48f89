"""LiDAR odometry: a log's poses refined by what stands still in its sweeps."""

from nurec_sim.logs.odometry.agreement import agreement_m
from nurec_sim.logs.odometry.refine import PoseReport, refine_poses

__all__ = ["PoseReport", "agreement_m", "refine_poses"]
