"""The dataparser that nerfstudio registers as `fisheye-depth-data`.

In a module of its own: a method and a dataparser registered from one module import in a circle.
"""

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig

fisheye_depth_data = DataParserSpecification(
    config=FisheyeDepthDataParserConfig(),
    description="Driving scene from fisheye or pinhole cameras, with LiDAR and monocular distance maps.",
)
