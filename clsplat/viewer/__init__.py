"""Write the viewer page, draw charts, and render videos."""
