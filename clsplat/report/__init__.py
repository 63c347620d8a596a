"""The parts of report.html: pictures, cameras, figures, curves, times."""
