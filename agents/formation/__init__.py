"""Formation graph and its theory: links, rigidity, anchors, changes of shape. Imports arrays only."""
