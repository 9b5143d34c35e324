"""Work on the map of the guide: import surveys of instruments and controllers, export the map."""

SUMMARY = "build the map of the guide from a survey, convert surveys, export a controller's error table"
TOOLS = ("build", "convert", "export")
