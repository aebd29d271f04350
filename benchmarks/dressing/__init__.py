"""Garments that ship in packages of others, and boxes of panels, dressed on the body of the demo."""
