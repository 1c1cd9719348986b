"""Files of demonstrations in the formats of other libraries; one file per format."""
