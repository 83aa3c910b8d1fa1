"""Where UAVs fly: polygons drawn, written down, or read from FIR tables and GeoJSON files."""
