"""Procedural rooms: layout, trajectories, ray caster, and pools of rendered rooms."""
