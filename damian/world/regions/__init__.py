"""Regions that UAVs fly over: random polygons, given vertices, or areas of FIR tables and maps."""
