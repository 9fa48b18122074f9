"""Who listens to whom, and what theory says of it: links, rigidity, anchors, changes of shape. Imports arrays only."""
