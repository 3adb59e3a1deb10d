"""Pictures of fitted surfaces under given lights, and their distance from photographs."""
