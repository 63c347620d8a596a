"""What every room needs: errors, files, locks, signals, settings, schedules, the terminal, pages."""
