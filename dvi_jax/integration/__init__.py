"""One trajectory: the loop over steps, its gradients, `integrate`."""
