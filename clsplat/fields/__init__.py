"""Fields of densities and colours: a network in the place of Gaussians."""
