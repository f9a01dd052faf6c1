"""The Letter's own figures, to be shown beside ours.

Vargas, Romero, Zhang and Marrugo, *Pixel-wise rational model for a structured light system*, Optics
Letters 2023. Its R2 is 500 to 700 mm; its target has 16x21 circles, taken in 25 poses.
"""

from dataclasses import dataclass

DEPTH_RANGE_MM = (500.0, 700.0)
SPHERE_RADIUS_MM = 98.0  # nominal; "a sphere of 196 mm diameter"


@dataclass(frozen=True)
class PlanePose:
    """A row of Table 1: shares of the board in R1, R2, R3 in percent; RMS in mm."""

    pose: int
    incidence: tuple[float, float, float]
    stereo_mm: float
    pixelwise_mm: float


@dataclass(frozen=True)
class SpherePose:
    """A row of Table 2: position of the sphere; RMS and fitted radius in mm."""

    pose: int
    region: str
    stereo_mm: float
    pixelwise_mm: float
    stereo_radius_mm: float
    pixelwise_radius_mm: float


TABLE_1 = (
    PlanePose(1, (100.0, 0.0, 0.0), 0.188, 0.068),
    PlanePose(2, (91.2, 8.8, 0.0), 0.237, 0.066),
    PlanePose(3, (0.0, 100.0, 0.0), 0.144, 0.070),
    PlanePose(4, (0.0, 100.0, 0.0), 0.127, 0.056),
    PlanePose(5, (0.0, 47.6, 52.4), 0.172, 0.091),
    PlanePose(6, (0.0, 0.7, 99.3), 0.205, 0.104),
    PlanePose(7, (0.0, 0.0, 100.0), 0.270, 0.163),
    PlanePose(8, (0.0, 0.0, 100.0), 0.214, 0.118),
    PlanePose(9, (2.1, 97.9, 0.0), 0.138, 0.053),
    PlanePose(10, (0.0, 87.0, 13.0), 0.146, 0.076),
)
TABLE_1_MEAN_MM = (0.184, 0.087)  # stereo, pixelwise
TABLE_1_RATIO_OF_MEANS = 2.13  # before rounding; the best row is 3.59, the Letter's "3.6 times"

TABLE_2 = (
    SpherePose(1, "R1", 0.109, 0.080, 98.44, 98.01),
    SpherePose(2, "R1", 0.096, 0.074, 98.28, 98.00),
    SpherePose(3, "R2", 0.086, 0.062, 98.27, 98.08),
    SpherePose(4, "R2", 0.076, 0.056, 98.20, 98.06),
    SpherePose(5, "R3", 0.092, 0.076, 98.25, 98.15),
    SpherePose(6, "R3", 0.085, 0.085, 98.10, 98.06),
)
TABLE_2_MEAN_MM = (0.091, 0.072)
# mean and standard deviation: stereo, pixelwise
TABLE_2_RADIUS_MM = (
    (98.256, 0.111),
    (98.060, 0.053),
)

EXPERIMENT_3_POINTS = {"R1": 1_642_179, "R2": 1_476_327, "R3": 1_034_094}
EXPERIMENT_3_ICP_RMS_MM = {"R1": 0.26, "R2": 0.25}  # with R3 as the reference

REPROJECTION_RMS_PX = {"camera": 0.253, "projector": 0.141}
