"""Registration of raw scans to the template's vertices: pose, shape, free form, confidence."""
