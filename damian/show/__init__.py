"""An episode as data, and what shows it: films, figures, GeoJSON and replay pages."""
