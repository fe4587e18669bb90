"""The Rerun blueprint of a flight: what is shown where. Needs ``zenfi[rerun]``."""

from __future__ import annotations

from pathlib import Path

APPLICATION = "zenfi"
"""To which the blueprint belongs; recordings are converted under this name."""

DRAWN = ("cloud", "occupied", "pose", "planned_path", "depth", "camera_info", "tf", "tf_static")
PLOTTED = ("command", "odometry", "collision_check")


def save(path: Path) -> None:
    """Write the blueprint (.rbl), as the installed version of Rerun reads it."""
    import rerun.blueprint as rrb  # noqa: PLC0415 - an extra, slow to import

    space = rrb.Spatial3DView(
        name="Flight",
        origin="/",
        contents=[f"+ /{topic}" for topic in DRAWN],
        spatial_information=rrb.archetypes.SpatialInformation(target_frame="map"),
    )
    image = rrb.Spatial2DView(name="Depth", origin="/depth")
    texts = rrb.Tabs(
        *(
            rrb.DataframeView(name=topic.replace("_", " "), origin=f"/{topic}")
            for topic in (*PLOTTED, "injection")
        ),
        name="Messages",
    )
    blueprint = rrb.Blueprint(
        rrb.Horizontal(space, rrb.Vertical(image, texts), column_shares=[3, 2]),
        rrb.TimePanel(timeline="message_log_time", state="expanded"),
        collapse_panels=True,
    )
    blueprint.save(APPLICATION, str(path))
