"""Which pixels teach, which are held out for calibration, and which have a known distance."""
