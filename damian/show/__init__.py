"""An episode as data, and what shows it: films, figures and replay pages."""
