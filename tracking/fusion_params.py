"""The settings of fusion, which all of its steps share."""

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator


class FusionParams(BaseModel):
    """Settings of fusion: the person that is projected, the gates of a match, what a match says, and the noise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pedestrian_labels: tuple[str, ...] = ("person", "pedestrian", "Person", "Pedestrian", "PEDESTRIAN")
    radius_m: float = Field(default=0.3, gt=0, description="of the cylinder that stands for a person")
    height_m: float = Field(default=1.75, gt=0)
    ground_below_vehicle_m: float = Field(default=0.0, description="from the vehicle frame's origin down to the ground")
    follow_track_m: float = Field(default=1.0, ge=0, description="a cluster this near a track moves with its velocity")

    min_overlap: float = Field(default=0.3, ge=0, le=1, description="horizontal, intersection over union")
    grown_box: float = Field(default=1.1, ge=1, description="or the centroid lies inside the box grown by this factor")
    max_height_log_ratio: float = Field(default=0.35, gt=0, description="of the box's height to the cylinder's")
    min_in_image: float = Field(default=0.6, ge=0, le=1, description="less of a person than this proves nothing")
    min_height_px: float = Field(default=25.0, ge=0, description="a missing box for anyone smaller proves nothing")
    full_height_px: float = Field(default=45.0, gt=0, description="and for anyone this tall as much as it can")
    nearer_by_m: float = Field(default=0.2, ge=0, description="a cluster this much nearer than a person may hide it")
    hiding_height_m: float = Field(default=1.2, gt=0, description="and hides it altogether if it is this tall")
    min_visible: float = Field(default=0.6, ge=0, lt=1, description="share of a person; with less it proves nothing")

    wide_for_two_m: float = Field(default=0.65, gt=0, description="a cluster wider than this may be several people")
    too_wide_to_split_m: float = Field(default=2.0, gt=0, description="and wider than this is something else")
    closest_people_m: float = Field(default=0.2, gt=0, description="two boxes nearer than this are one person's")
    split_sigma_m: float = Field(default=0.1, ge=0, description="more noise of each part of a cluster that was split")

    p_box: float = Field(default=0.7, gt=0, lt=1, description="a camera gives a person in plain view a box")
    p_box_other: float = Field(default=0.05, gt=0, lt=1, description="and anything else")
    max_box_log_odds: float = Field(default=3.0, gt=0)
    min_box_log_odds: float = Field(default=0.5, ge=0)
    max_log_odds: float = Field(default=4.0, gt=0, description="of the sum over cameras")

    camera_only: bool = Field(default=True, description="a box that lies on no cluster is a measurement, too")
    camera_births: bool = Field(
        default=False, description="even the box of a single camera, without a cluster, may be a new person"
    )
    camera_only_range_m: float = Field(default=40.0, gt=0, description="farther feet on the ground are not known")
    foot_bias_m: float = Field(default=0.2, description="a box ends at the near side of a person's feet, so far ahead")
    foot_sigma: float = Field(default=0.03, ge=0, description="of a box's lower edge, as a share of its height")
    foot_sigma_rad: float = Field(default=0.004, ge=0, description="of the vehicle's pitch and the ground's slope")
    camera_across_sigma_m: float = Field(default=0.15, gt=0, description="a box shows the visible part of a person")

    base_log_odds: float = Field(default=0.3, description="of a cluster of a person's size being one")
    max_width_m: float = Field(default=1.1, gt=0, description="wider clusters than this are less and less likely")
    max_height_m: float = Field(default=2.1, gt=0, description="so are taller ones")
    pole_width_m: float = Field(default=0.2, ge=0, description="a well-seen cluster thinner than this may be a pole")

    centroid_bias_m: float = Field(default=0.12, description="how far a centroid lies on the near side of a person")
    range_sigma_m: float = Field(default=0.08, gt=0)
    cross_sigma_m: float = Field(default=0.08, gt=0)
    single_point_sigma_m: float = Field(default=0.2, ge=0, description="more for one point; falls with their root")
    bearing_sigma_rad: float = Field(default=0.003, ge=0, description="bearing noise and the pose's yaw")
    extrapolated_pose_sigma_m: float = Field(default=0.05, ge=0)

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if self.full_height_px <= self.min_height_px:
            raise ValueError(
                f"full_height_px {self.full_height_px:g} must be over min_height_px {self.min_height_px:g}"
            )
        return self
