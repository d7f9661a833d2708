"""ihbench measures how well a method rebuilds an occluded person as an animatable 3D avatar."""

__version__ = "0.1.0"
