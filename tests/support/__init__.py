"""What tests and their authors share."""
