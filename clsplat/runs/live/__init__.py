"""A page that shows a run while it trains, served to this machine only."""
