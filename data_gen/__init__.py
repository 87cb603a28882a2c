"""From meshes and procedural objects to data sets: materials, surface points, rendered views, records on disk."""
