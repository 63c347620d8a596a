"""What people look at: the viewer page, charts, video."""
