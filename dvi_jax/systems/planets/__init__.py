"""The solar system: planets, relativity, polar motion."""
