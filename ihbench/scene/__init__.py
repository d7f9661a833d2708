"""What a run is about: contracts, protocol, occlusion, views, what they show of the surface, regions, plan."""
