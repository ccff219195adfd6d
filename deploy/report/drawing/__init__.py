"""What all figures are drawn with: style and marks, layout, labels, faults above the axes, two processes."""
