"""Pictures of an asset: light, cameras, depth, what each view sees."""
