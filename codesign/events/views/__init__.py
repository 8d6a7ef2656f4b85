"""Events made visible: pictures, videos, rate curves, space-time plots."""
