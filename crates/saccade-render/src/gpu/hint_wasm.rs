pub(super) const NO_ADAPTER: &str = "this browser offers no WebGPU; use a recent Chrome, Edge, \
    Safari or Firefox, and see about:gpu or chrome://gpu";
