"""The fault laboratory (`./zenpark test --chaos`) and the soak (`./zenpark test --soak`): runs watched from outside."""
