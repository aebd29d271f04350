"""Bodies that bones move: motions of skeletons (BVH, AMASS), and the surfaces that follow them."""
