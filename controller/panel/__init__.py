"""The technician's web panel and the API: what a person sees of a kiosk and may ask of it (docs/panel.md)."""
