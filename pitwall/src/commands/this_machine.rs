//! The names and addresses under which others reach this machine.

use std::net::{IpAddr, UdpSocket};

/// Names and addresses, the loopback's first.
pub(super) fn names() -> Vec<String> {
    let mut hosts = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
    if let Some(name) = sysinfo::System::host_name().filter(|name| name.is_ascii() && !name.is_empty()) {
        hosts.push(format!("{name}.local"));
        hosts.push(name);
    }
    for address in addresses() {
        let address = address.to_string();
        if !hosts.contains(&address) {
            hosts.push(address);
        }
    }
    hosts
}

/// The addresses on private networks. Without a network there is none.
pub(super) fn addresses() -> Vec<IpAddr> {
    let mut addresses = Vec::new();
    // A datagram socket that is "connected" sends nothing, and knows the address it would send from.
    for target in ["10.255.255.255:9", "192.168.255.255:9", "172.31.255.255:9"] {
        let address = UdpSocket::bind("0.0.0.0:0")
            .and_then(|socket| socket.connect(target).map(|()| socket))
            .and_then(|socket| socket.local_addr());
        if let Ok(address) = address
            && !addresses.contains(&address.ip())
        {
            addresses.push(address.ip());
        }
    }
    addresses
}
